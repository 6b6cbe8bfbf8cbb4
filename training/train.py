"""The loop: batches drawn by (seed, step), AdamW with a cosine, averaged weights, checkpoints to go on from."""

from __future__ import annotations

import csv
import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from training.buffers import open_store
from training.evaluate import Look, evaluate
from training.export import read_network
from training.losses import Weights, loss_parts, total
from training.network import ScopeNet
from training.recipe import Recipe
from training.samples import Batch, make_batch

Say = Callable[[str], None]
# On the way every second pixel does.
_CHECKED = Look(stride=2)
_LOG_COLUMNS = ("step", "seconds", "rate", "loss", "likelihood", "l1", "gradient", "normal", "scale", "held_out")


class Training:
    """One training of one recipe in one folder: `run` begins it, or goes on where it was stopped.

    `start` names weights to begin from instead of the random ones of the recipe's seed.
    """

    def __init__(
        self, recipe: Recipe, scenes: Path, folder: Path, device: str, say: Say, *, start: Path | None = None
    ) -> None:
        self.recipe, self.folder, self.device, self._say = recipe, folder, device, say
        self._stores = {part.name: open_store(scenes / part.name) for part in (*recipe.parts, recipe.held_out)}
        torch.manual_seed(recipe.seed)
        self.network = ScopeNet().to(device, memory_format=torch.channels_last)
        if start is not None:
            # A head for instruments reads features that are about to change.
            known = read_network(start).state_dict().items()
            self.network.load_state_dict({k: v for k, v in known if not k.startswith("instruments.")})
        average = get_ema_multi_avg_fn(recipe.ema)
        self.averaged = AveragedModel(self.network, multi_avg_fn=average, use_buffers=True)
        self._optimiser = torch.optim.AdamW(self.network.parameters(), lr=recipe.rate, weight_decay=recipe.decay)
        self._half = device != "cpu" or torch.cpu._is_avx512_bf16_supported()
        self._step = 0
        self._checkpoint = folder / "checkpoint.pt"

    def run(self, threads: int = 1) -> ScopeNet:
        """Train to the end and return the averaged network, on the CPU and ready for use."""
        self._resume()
        began = time.perf_counter()
        sums: list[dict[str, float]] = []
        with ThreadPoolExecutor(max(threads, 1)) as pool, ThreadPoolExecutor(1) as ahead:
            waiting = ahead.submit(self._draw, self._step, pool)
            while self._step < self.recipe.steps:
                batch = waiting.result()
                waiting = ahead.submit(self._draw, min(self._step + 1, self.recipe.steps - 1), pool)
                sums.append(self._update(batch))
                self._step += 1
                if self._step % self.recipe.check_every == 0 or self._step == self.recipe.steps:
                    self._check(sums, time.perf_counter() - began)
                    sums = []
        return self.averaged.module.cpu().eval()

    def _draw(self, step: int, pool: ThreadPoolExecutor) -> Batch:
        rng = np.random.default_rng((self.recipe.seed, 1, step))
        uses = self.recipe.uses_at(step)
        shares = np.array([use.share for use in uses])
        use = uses[rng.choice(len(uses), p=shares / shares.sum())]
        store = self._stores[use.part]
        indices = rng.integers(len(store), size=use.batch)
        return make_batch(store, indices, (self.recipe.seed, 2, step), pool, stride=use.stride)

    def _update(self, batch: Batch) -> dict[str, float]:
        for group in self._optimiser.param_groups:
            group["lr"] = self._rate()
        planes = torch.from_numpy(batch.planes).to(self.device, memory_format=torch.channels_last)
        self.network.train()
        with torch.autocast(self.device.split(":")[0], torch.bfloat16, enabled=self._half):
            prediction = self.network(planes)
        truth, rays = (torch.from_numpy(array).to(self.device) for array in (batch.log_distance, batch.rays))
        parts = loss_parts(prediction, truth, rays)
        loss = total(parts, Weights())
        self._optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.recipe.clip)
        self._optimiser.step()
        self.averaged.update_parameters(self.network)
        return {"loss": float(loss.detach())} | {name: float(value.detach()) for name, value in parts.items()}

    def _rate(self) -> float:
        recipe = self.recipe
        if self._step < recipe.warm_up:
            return recipe.rate * (self._step + 1) / recipe.warm_up
        way = (self._step - recipe.warm_up) / max(recipe.steps - recipe.warm_up, 1)
        return recipe.rate_end + (recipe.rate - recipe.rate_end) * 0.5 * (1 + math.cos(math.pi * way))

    def _check(self, sums: list[dict[str, float]], seconds: float) -> None:
        store = self._stores[self.recipe.held_out.name]
        held_out = evaluate(self.averaged.module.eval(), store, _CHECKED, self.device, limit=120)
        mean = {name: float(np.mean([entry[name] for entry in sums])) for name in sums[0]}
        row = {"step": self._step, "seconds": seconds, "rate": self._rate(), "held_out": held_out.abs_rel} | mean
        with (self.folder / "log.csv").open("a", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            if not stream.tell():
                writer.writerow(_LOG_COLUMNS)
            writer.writerow([f"{row[name]:.6g}" for name in _LOG_COLUMNS])
        self._save()
        self._say(
            f"step {self._step} of {self.recipe.steps}: L1 {mean['l1']:.4f}, held-out AbsRel {held_out.abs_rel:.4f}, "
            f"{seconds:.0f} s"
        )

    def _save(self) -> None:
        state = {
            "network": self.network.state_dict(),
            "averaged": self.averaged.state_dict(),
            "optimiser": self._optimiser.state_dict(),
            "step": self._step,
            "recipe": self.recipe.toml(),
        }
        draft = self._checkpoint.with_suffix(".part")
        torch.save(state, draft)
        draft.replace(self._checkpoint)

    def _resume(self) -> None:
        if not self._checkpoint.is_file():
            return
        state = torch.load(self._checkpoint, map_location=self.device, weights_only=True)
        if state["recipe"] != self.recipe.toml():
            raise SystemExit(f"{self._checkpoint} was begun with another recipe: use another folder")
        self.network.load_state_dict(state["network"])
        self.averaged.load_state_dict(state["averaged"])
        self._optimiser.load_state_dict(state["optimiser"])
        self._step = state["step"]
        self._say(f"going on from step {self._step}")
