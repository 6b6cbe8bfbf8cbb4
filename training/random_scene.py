"""Random scenes of every kind, in fixed shares."""

from __future__ import annotations

import numpy as np

from training.scene import AIRWAY, BAG, COLON, LAPAROSCOPY, SINUS, WALL, Scene
from training.scene_abdomen import laparoscopy, wall
from training.scene_cavities import bag, sinus
from training.scene_tubes import airway, colon

_SHARES = ((COLON, 0.35), (LAPAROSCOPY, 0.25), (WALL, 0.12), (BAG, 0.10), (AIRWAY, 0.08), (SINUS, 0.10))
_MAKERS = {COLON: colon, AIRWAY: airway, BAG: bag, SINUS: sinus, LAPAROSCOPY: laparoscopy, WALL: wall}


def kind_of(index: int, seed: int) -> int:
    """Return the kind of scene `index` of a set: the shares are fixed, the order is shuffled in blocks of 100."""
    counts = [round(100 * share) for _, share in _SHARES]
    deck = np.repeat([kind for kind, _ in _SHARES], counts)
    return int(np.random.default_rng((seed, index // 100, 77)).permutation(deck)[index % 100])


def random_scene(kind: int, rng: np.random.Generator) -> Scene:
    """Return a random scene of that kind."""
    return _MAKERS[kind](rng)
