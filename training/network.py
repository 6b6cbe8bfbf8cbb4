"""ScopeNet: a compact encoder-decoder from an endoscope's image and its rays to distance and its uncertainty.

Residual blocks (He et al., CVPR 2016) on six scales with skips, a global context in the middle, decoded to the full
resolution so that the edges of folds stay where they are. Trained from nothing on the project's own phantom
(`training/`).
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from scopemap.engine.depth.scopenet.planes import PLANES, STRIDE

WIDTHS = (24, 48, 80, 128, 160)
_BLOCKS = (1, 2, 2, 3, 2)
_HEAD = 16
INSTRUMENT_WIDTHS = (8, 16, 32, 48, 48)
_SEEN = (24, 32)  # channels of what is seen of the planes at 1/4 and 1/8
TYPICAL_LOG_MM = 3.4  # 30 mm: the network starts from there
TYPICAL_LOG_SPREAD = -2.0
SPREAD_RANGE = (-5.0, 1.0)


class Block(nn.Module):
    """Two convolutions with a short cut around them."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = _convolution(width, width), _convolution(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """Return features of the shape of `x` (N, width, H, W)."""
        return functional.relu(x + self.second(functional.relu(self.first(x))))


class Context(nn.Module):
    """Adds global image features to every pixel."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(width, width), nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """Return features of the shape of `x` (N, width, H, W)."""
        whole = self.second(functional.relu(self.first(x.mean((2, 3)))))
        return functional.relu(x + whole[:, :, None, None])


class Merge(nn.Module):
    """Brings coarse features to the next finer scale, where they meet the encoder's."""

    def __init__(self, coarse: int, fine: int) -> None:
        super().__init__()
        self.from_coarse, self.from_fine = nn.Conv2d(coarse, fine, 1), nn.Conv2d(fine, fine, 1)
        self.block = Block(fine)

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        """Return features of the shape of `fine`, which is twice as high and wide as `coarse`."""
        # The short side first: a 1x1 convolution and the enlargement commute.
        enlarged = functional.interpolate(self.from_coarse(coarse), scale_factor=2.0, mode="bilinear")
        return self.block(functional.relu(enlarged + self.from_fine(fine)))


class InstrumentHead(nn.Module):
    """From the encoder's features to where instruments are seen, at half the resolution: a small decoder of its own.

    Depth is learnt to be blind to colour; so 4x4 patches of the planes themselves are read, too.
    """

    def __init__(self, widths: tuple[int, ...] = WIDTHS, own: tuple[int, ...] = INSTRUMENT_WIDTHS) -> None:
        super().__init__()
        self.quarter = nn.Sequential(nn.Conv2d(PLANES, _SEEN[0], 4, 4, bias=False), nn.BatchNorm2d(_SEEN[0]), nn.ReLU())
        self.eighth = nn.Sequential(_convolution(*_SEEN, 2), nn.ReLU())
        self.start = nn.Conv2d(widths[-1], own[-1], 1)
        self.middle = Block(own[-1])
        skips = (widths[0], widths[1] + _SEEN[0], widths[2] + _SEEN[1], widths[3])
        self.merges = nn.ModuleList(
            InstrumentMerge(coarse, skip, fine)
            for (fine, coarse), skip in zip(reversed(list(pairwise(own))), reversed(skips), strict=True)
        )
        self.last = nn.Conv2d(own[0], 1, 3, padding=1)

    def forward(self, planes: Tensor, scales: list[Tensor]) -> Tensor:
        """Return logits (N, 1, H/2, W/2) from planes, and features at 1/2, 1/4, 1/8, 1/16, 1/32 (with its context)."""
        quarter = self.quarter(planes)
        eighth = self.eighth(quarter)
        half, second, third, fourth, coarsest = scales
        x = self.middle(functional.relu(self.start(coarsest)))
        skips = (fourth, torch.cat([third, eighth], 1), torch.cat([second, quarter], 1), half)
        for merge, fine in zip(self.merges, skips, strict=True):
            x = merge(x, fine)
        logits: Tensor = self.last(x)
        return logits


class InstrumentMerge(nn.Module):
    """As `Merge`, with features of another width from the encoder, and with one convolution alone."""

    def __init__(self, coarse: int, skip: int, fine: int) -> None:
        super().__init__()
        self.from_coarse, self.from_fine = nn.Conv2d(coarse, fine, 1), nn.Conv2d(skip, fine, 1)
        self.block = nn.Sequential(_convolution(fine, fine), nn.ReLU())

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        """Return features of the shape of `fine`, which is twice as high and wide as `coarse`."""
        enlarged = functional.interpolate(self.from_coarse(coarse), scale_factor=2.0, mode="bilinear")
        merged: Tensor = self.block(functional.relu(enlarged + self.from_fine(fine)))
        return merged


class ScopeNet(nn.Module):
    """The network.

    widths : channels at 1/2, 1/4, 1/8, 1/16 and 1/32 of the resolution. blocks : residual blocks there.
    instruments : whether it has a head for them, which reads the features of the depth's encoder and changes nothing
        of it.
    """

    def __init__(
        self, widths: tuple[int, ...] = WIDTHS, blocks: tuple[int, ...] = _BLOCKS, *, instruments: bool = False
    ) -> None:
        super().__init__()
        entries = [_convolution(a, b, 2) for a, b in pairwise((PLANES, *widths))]
        self.stages = nn.ModuleList(
            nn.Sequential(entry, nn.ReLU(), *(Block(width) for _ in range(count)))
            for entry, width, count in zip(entries, widths, blocks, strict=True)
        )
        self.context = Context(widths[-1])
        self.merges = nn.ModuleList(Merge(coarse, fine) for fine, coarse in reversed(list(pairwise(widths))))
        self.from_coarse, self.from_planes = nn.Conv2d(widths[0], _HEAD, 1), _convolution(PLANES, _HEAD)
        self.detail = _convolution(_HEAD, _HEAD)
        self.head = nn.Conv2d(_HEAD, 2, 3, padding=1)
        for start in self.head.parameters():
            nn.init.zeros_(start)
        self.instruments = InstrumentHead(widths) if instruments else None

    def features(self, planes: Tensor) -> list[Tensor]:
        """Return the encoder's features of planes (N, 8, H, W), sides multiples of `STRIDE`, from fine to coarse."""
        x, scales = planes, []
        for stage in self.stages:
            x = stage(x)
            scales.append(x)
        return [*scales[:-1], self.context(x)]

    def forward(self, planes: Tensor) -> Tensor:
        """Return (N, 2, H, W) from planes (N, 8, H, W), any H and W.

        Channel 0: ln of the distance along the ray, mm. Channel 1: ln of the Laplace scale of channel 0's error.
        """
        height, width = planes.shape[-2:]
        full = functional.pad(planes, (0, -width % STRIDE, 0, -height % STRIDE))
        scales = self.features(full)
        x = scales[-1]
        for merge, fine in zip(self.merges, reversed(scales[:-1]), strict=True):
            x = merge(x, fine)
        x = functional.interpolate(self.from_coarse(x), scale_factor=2.0, mode="bilinear")
        x = functional.relu(self.detail(functional.relu(x + self.from_planes(full))))
        x = self.head(x)[..., :height, :width].float()
        return torch.stack([x[:, 0] + TYPICAL_LOG_MM, (x[:, 1] + TYPICAL_LOG_SPREAD).clamp(*SPREAD_RANGE)], 1)


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False),
        nn.BatchNorm2d(outputs),
    )
