"""A frame through all steps of a pipeline, one after the other, as the loop of a run takes it through them."""

from __future__ import annotations

from scopemap.engine.frame import Frame
from scopemap.engine.odometry import Step
from scopemap.engine.pipeline import Pipeline


def stepped(pipeline: Pipeline, frame: Frame) -> Step:
    """Return what became of the next frame."""
    step = pipeline.track(pipeline.match(pipeline.estimate(frame)))
    pipeline.fuse(step)
    return step
