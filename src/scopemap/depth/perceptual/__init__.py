"""Image pair to perceptual distance: a contract and what stands behind it."""

from scopemap.depth.perceptual.distance import PerceptualDistance, PerceptualResult
from scopemap.depth.perceptual.lpips_alex import CHECKPOINTS, LpipsAlex
from scopemap.depth.perceptual.structure import StructureDistance
from scopemap.errors import SettingsError
from scopemap.io import weights

__all__ = ["LpipsAlex", "PerceptualDistance", "PerceptualResult", "StructureDistance", "create_perceptual"]


def create_perceptual(name: str = "auto", device: str = "auto") -> PerceptualDistance:
    """Return the distance "lpips", "structure", or with "auto" lpips if its weights are at hand, else structure.

    Raises `SettingsError` for an unknown name and `WeightsError` where lpips lacks its weights.
    """
    if name == "auto":
        name = "lpips" if weights.is_present(*CHECKPOINTS) else "structure"
    match name:
        case "lpips":
            return LpipsAlex(device=device)
        case "structure":
            return StructureDistance()
    raise SettingsError(f"unknown perceptual distance '{name}': choose one of auto, lpips, structure")
