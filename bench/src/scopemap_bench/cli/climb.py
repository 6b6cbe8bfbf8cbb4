"""`scopemap climb`: runs as a submission to the CLiMB challenge."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from scopemap.engine.errors import InputError
from scopemap.terminal.options import AsJson, Quiet


def climb(
    out: Annotated[Path, typer.Option(help="Folder of the submission; clips are added to it.")],
    runs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[RUN]...", help="Folders of runs; without any, only --out is checked."),
    ] = None,
    clip: Annotated[str, typer.Option(help="Name of the clip; default: that of the run's input.")] = "",
    videos: Annotated[
        Path | None, typer.Option(help="Folder of the challenge's videos; every video must have a clip.")
    ] = None,
    truth: Annotated[
        Path | None, typer.Option(help="Folder of the references, CLIP/results_txt/images.txt: scores the submission.")
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Convert runs into a CLiMB submission, check it, and score it.

    Each run becomes the five runs of a clip. The exit code is 1 if the submission breaks a rule of the challenge. With
    --truth the score is the mean over all clips, failed ones included.
    """
    from scopemap_bench.climb.ranking import ranking_of
    from scopemap_bench.climb.submission import submission_problems, write_submission

    written = [write_submission(run, out, clip) for run in runs or []]
    problems = submission_problems(out, videos)
    ranking = None if truth is None else ranking_of(out, truth)
    if as_json:
        facts = {"out": str(out), "format": "climb", "written": written, "problems": problems}
        scores = {} if ranking is None else {"final": asdict(ranking.final), **asdict(ranking)}
        typer.echo(json.dumps(facts | scores, indent=2))
    elif not quiet:
        typer.echo("\n".join(problems) or f"{out}: valid")
        for name, score in {} if ranking is None else {**ranking.clips, "mean over the clips": ranking.final}.items():
            failed = ", failed" if ranking is not None and name in ranking.failed else ""
            typer.echo(f"{name}: score {score.ate:.3f}, rotation {score.rotation:.3f} (decides a tie){failed}")
    if problems:
        raise InputError(f"{out}: {len(problems)} problems, the first: {problems[0]}")
