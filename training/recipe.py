"""Everything that decides what comes out of a training: written beside the result, read back by `--recipe`."""

from __future__ import annotations

import tomllib
from dataclasses import asdict, dataclass, fields
from pathlib import Path


@dataclass(frozen=True)
class Part:
    """A part of the rendered scenes: `count` scenes of one size, and how many pictures of them make a step."""

    name: str
    width: int
    height: int
    count: int
    batch: int
    share: float


@dataclass(frozen=True)
class Recipe:
    """Settings of one training.

    Attributes
    ----------
    seed : of the network's start and of every draw while training. scene_seed : of the scenes.
    steps : updates. rate, rate_end : learning rate after the warm-up and at the end (cosine). warm_up : steps.
    decay : weight decay. ema : decay of the averaged weights. clip : largest norm of the gradient.
    check_every : steps between validations and checkpoints.
    """

    seed: int = 0
    scene_seed: int = 1
    steps: int = 3600
    rate: float = 2e-3
    rate_end: float = 1e-5
    warm_up: int = 200
    decay: float = 0.02
    ema: float = 0.998
    clip: float = 1.0
    check_every: int = 300
    parts: tuple[Part, ...] = (
        Part("small", 160, 128, 10000, 16, 0.75),
        Part("large", 320, 256, 1500, 4, 0.25),
    )
    held_out: Part = Part("held-out", 160, 128, 300, 16, 0.0)

    def toml(self) -> str:
        """Return the plain settings as TOML, for the record."""
        lines = [f"{f.name} = {getattr(self, f.name)}" for f in fields(self) if f.name not in ("parts", "held_out")]
        for part in (*self.parts, self.held_out):
            text = ", ".join(f'{k} = "{v}"' if isinstance(v, str) else f"{k} = {v}" for k, v in asdict(part).items())
            lines.append(f"[[{'held_out' if part == self.held_out else 'parts'}]]  # {text}")
            lines += [f'{k} = "{v}"' if isinstance(v, str) else f"{k} = {v}" for k, v in asdict(part).items()]
        return "\n".join(lines) + "\n"

    @classmethod
    def read(cls, file: Path) -> Recipe:
        """Return the recipe of a file that `toml` wrote, or that names some of its settings."""
        values = tomllib.loads(Path(file).read_text(encoding="utf-8"))
        if "parts" in values:
            values["parts"] = tuple(Part(**part) for part in values["parts"])
        if "held_out" in values:
            values["held_out"] = Part(**values["held_out"][0])
        return cls(**values)
