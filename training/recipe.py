"""Everything that decides what comes out of a training: written beside the result, read back by `--recipe`."""

from __future__ import annotations

import json
import tomllib
from dataclasses import asdict, dataclass, fields
from pathlib import Path


@dataclass(frozen=True)
class Part:
    """A part of the rendered scenes: `count` scenes of one size, px."""

    name: str
    width: int
    height: int
    count: int


@dataclass(frozen=True)
class Use:
    """How a part is used: every `stride`-th pixel of it, `batch` pictures a step, in an interval of the training.

    begin, end : shares of all steps. share : of the steps in that interval, against the other uses there.
    """

    part: str
    stride: int
    batch: int
    share: float
    begin: float = 0.0
    end: float = 1.0


@dataclass(frozen=True)
class Recipe:
    """Settings of one training.

    seed : of the network's start and of every draw while training. scene_seed : of the scenes.
    steps : updates. rate, rate_end : learning rate after the warm-up and at the end (cosine). warm_up : steps.
    decay : weight decay. ema : decay of the averaged weights. clip : largest norm of the gradient.
    check_every : steps between validations and checkpoints. parts : what is rendered. uses : what of it
    is shown when. held_out : scenes that only validation sees.
    """

    seed: int = 0
    scene_seed: int = 1
    steps: int = 8000
    rate: float = 2e-3
    rate_end: float = 1e-5
    warm_up: int = 200
    decay: float = 0.02
    ema: float = 0.998
    clip: float = 1.0
    check_every: int = 300
    parts: tuple[Part, ...] = (Part("small", 160, 128, 18000), Part("large", 320, 256, 1500))
    # Coarse pictures first: the shape of a whole picture is learnt four times as fast from a quarter of its pixels.
    uses: tuple[Use, ...] = (
        Use("small", 2, 32, 1.0, 0.0, 0.6),
        Use("small", 1, 16, 0.6, 0.6, 1.0),
        Use("large", 1, 4, 0.4, 0.6, 1.0),
    )
    held_out: Part = Part("held-out", 320, 256, 300)

    def uses_at(self, step: int) -> list[Use]:
        """Return the uses that take part in a step."""
        progress = step / self.steps
        return [use for use in self.uses if use.begin <= progress < use.end]

    def toml(self) -> str:
        """Return all settings as TOML that `read` reads back."""
        tables = {"parts": self.parts, "uses": self.uses, "held_out": (self.held_out,)}
        lines = [f"{f.name} = {json.dumps(getattr(self, f.name))}" for f in fields(self) if f.name not in tables]
        for name, rows in tables.items():
            for row in rows:
                lines += [f"[[{name}]]", *(f"{key} = {json.dumps(value)}" for key, value in asdict(row).items())]
        return "\n".join(lines) + "\n"

    @classmethod
    def read(cls, file: Path) -> Recipe:
        """Return the recipe of a file that `toml` wrote, or that names some of its settings."""
        values = tomllib.loads(Path(file).read_text(encoding="utf-8"))
        if "parts" in values:
            values["parts"] = tuple(Part(**row) for row in values["parts"])
        if "uses" in values:
            values["uses"] = tuple(Use(**row) for row in values["uses"])
        if "held_out" in values:
            values["held_out"] = Part(**values["held_out"][0])
        return cls(**values)
