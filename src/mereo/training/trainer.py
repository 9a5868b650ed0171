"""Loop of training, plain over batches; running the same command again continues where it stopped.

Everything random in step t is drawn from (seed, t), so a resumed run repeats an uninterrupted one exactly. Under
``torchrun`` each process takes its share of every batch; process 0 writes.
"""

import copy
import math
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor, nn

from mereo.models.device import compiling_pays, keep_freed_memory, pick_device, pick_precision
from mereo.models.encoders.autodecoder import CODES, Autodecoder
from mereo.models.model import Model
from mereo.models.network import Network
from mereo.models.weights import save_model
from mereo.training.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from mereo.training.config import TrainConfig
from mereo.training.dataset import Batch, Dataset
from mereo.training.losses import REST_WEIGHT, occupancy_loss, rest_loss
from mereo.training.metrics_log import MetricsLog
from mereo.training.run_directory import Process, claim_run, fit_config, join_processes, start_network
from mereo.training.validation import choose_offsets, held_out, validate


def train(dataset_dir: Path, run_dir: Path, config: TrainConfig, *, checkpoint_every_s: float = 120.0) -> Path:
    """Train on a generated dataset; returns the path of the weights (``run_dir/weights.safetensors``).

    ``run_dir`` receives config.json, metrics.csv, curves.png, checkpoint.safetensors and weights.safetensors. If it
    holds a checkpoint of the same settings, training continues from it; other settings raise ``ValueError``.
    """
    process = join_processes()
    device = pick_device(process.rank)
    data = Dataset.load(dataset_dir, device)
    config = fit_config(config, data)
    network = start_network(config, data)  # before anything is written: the weights it starts from may be unusable
    claim_run(run_dir, config, data, process)
    keep_freed_memory()
    trainer = Trainer(config, data, network, run_dir, process, device)
    if isinstance(network.encoder, Autodecoder):
        shown = len(held_out(data, config))
        trainer.say(f"the validation curve shows {shown} held-out examples, with codes found from their clouds")
    if trainer.resume():
        trainer.say(f"continuing from step {trainer.step} of {trainer.total}")
    last_save = time.monotonic()
    for batch in trainer.batches():
        trainer.train_step(batch)
        finished = trainer.step == trainer.total
        if finished or trainer.agree(time.monotonic() - last_save > checkpoint_every_s):
            trainer.validate_and_save(finished)
            last_save = time.monotonic()
    if process.world > 1:
        dist.destroy_process_group()
    return run_dir / "weights.safetensors"


REPORT_EVERY = 20
"""Steps between two lines of progress."""


class Trainer:
    """Run of a training, with its mutable state: network, optimizer, averaged weights, step."""

    def __init__(
        self,
        config: TrainConfig,
        data: Dataset,
        network: Network,
        run_dir: Path,
        process: Process,
        device: torch.device,
    ) -> None:
        self.config, self.data, self.run_dir, self.process, self.device = config, data, run_dir, process, device
        self.network = network.to(device)
        self.average = copy.deepcopy(self.network)
        self.optimizer = torch.optim.AdamW(_parameter_groups(self.network, config), lr=config.learning_rate, fused=True)
        self.examples = len(data) - config.holdout
        self.orders: dict[int, Tensor] = {}
        self.total = max(1, math.ceil(config.epochs * self.examples / config.batch))
        self.step = 0
        self.log = MetricsLog(run_dir) if process.is_main else None
        self.unread: list[tuple[int, float, dict[str, Tensor]]] = []
        self.autocast = pick_precision(config.precision, device)
        self.module: nn.Module = self.network
        if process.world > 1:
            self.module = nn.parallel.DistributedDataParallel(self.network)
        if config.compile == "on" or (config.compile == "auto" and compiling_pays(device, self.total)):
            self.module = torch.compile(self.module)  # type: ignore[assignment]
        self.started, self.first_step = time.monotonic(), 0

    def say(self, text: str) -> None:
        """Print a line, in process 0 only."""
        if self.process.is_main:
            print(text, flush=True)

    def agree(self, wish: bool) -> bool:
        """Wish of process 0, which decides for all: clocks differ, and validation is collective."""
        if self.process.world == 1:
            return wish
        flag = torch.tensor([float(wish)], device=self.device)
        dist.broadcast(flag, src=0)
        return bool(flag.item())

    def batches(self) -> Iterator[Batch]:
        """Share of this process in every remaining batch."""
        per_process = self.config.batch // self.process.world
        while self.step < self.total:
            index = self._batch_index(self.step)[self.process.rank * per_process :][:per_process]
            rng = torch.Generator().manual_seed(_seed(self.config.seed, self.step, self.process.rank))
            yield self.data.batch(index, self.config.network.points, self.config.queries, self.config.augment, rng)

    def _batch_index(self, step: int) -> Tensor:
        """Batches run through one shuffled pass after another; a batch may straddle two passes."""
        first = step * self.config.batch
        positions = range(first, first + self.config.batch)
        return torch.stack([self._order(p // self.examples)[p % self.examples] for p in positions])

    def _order(self, number: int) -> Tensor:
        """The shuffled examples of pass ``number``; the two latest are kept."""
        if number not in self.orders:
            generator = torch.Generator().manual_seed(_seed(self.config.seed, number, 1 << 20))
            order = torch.randperm(self.examples, generator=generator)
            self.orders = {n: kept for n, kept in self.orders.items() if n == number - 1} | {number: order}
        return self.orders[number]

    def train_step(self, batch: Batch) -> None:
        """Take one optimizer step."""
        self.network.train()
        part = self._schedule()
        for group in self.optimizer.param_groups:
            group["lr"] = group["peak"] * part
        torch.manual_seed(_seed(self.config.seed, self.step, self.process.rank))  # for dropout
        loss, terms = self._loss(batch)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if self.config.clip_norm:
            nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip_norm)
        self.optimizer.step()
        self.step += 1
        self._update_average()
        if self.log is not None:
            self.unread.append((self.step, self.config.learning_rate * part, {"loss": loss.detach(), **terms}))
            if self.step % REPORT_EVERY == 0 or self.step == self.total:
                self._report_progress()

    def _loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of a batch, and its terms by name for the record."""
        with torch.autocast(self.device.type, self.autocast) if self.autocast else nullcontext():
            prediction, coarse = self.module(batch.cloud, batch.viewpoint, batch.positions, batch.index)
        loss, terms = occupancy_loss(
            prediction,
            batch.labels,
            batch.distances,
            batch.directions,
            self.config.supervision,
            self.config.l1_weight,
        )
        if coarse is not None:
            terms["align"] = rest_loss(coarse, batch.rest[:, : coarse.shape[1]])
            loss = loss + terms["align"]
        if prediction.rest is not None:
            terms["rest"] = rest_loss(prediction.rest, batch.rest)
            loss = loss + REST_WEIGHT * terms["rest"]
        if isinstance(self.network.encoder, Autodecoder):
            terms["code"] = self.network.encoder.length_penalty(self.network.encoder.code(batch.index)).mean()
            loss = loss + self.config.l1_weight * terms["code"]
        return loss, {name: value.detach() for name, value in terms.items()}

    def _schedule(self) -> float:
        """The share of its peak that each learning rate has in this step."""
        config = self.config
        progress = self.step / self.total
        if progress < config.warmup:
            return (self.step + 1) / math.ceil(config.warmup * self.total)
        if config.schedule == "constant":
            return 1.0
        return 0.5 * (1 + math.cos(math.pi * (progress - config.warmup) / (1 - config.warmup)))

    @torch.no_grad()
    def _update_average(self) -> None:
        # a young average follows closely, so that the random initialization is forgotten
        decay = min(self.config.ema_decay, (1 + self.step) / (10 + self.step)) if self.config.ema_decay else 0.0
        for mean, value in zip(self.average.state_dict().values(), self.network.state_dict().values(), strict=True):
            if mean.is_floating_point():
                mean.lerp_(value, 1 - decay)
            else:
                mean.copy_(value)

    def _read_losses(self) -> None:
        """Log the steps since the last call, all with one copy from the device, which would wait at every step."""
        if self.log is None or not self.unread:
            return
        values = torch.stack([torch.stack(list(terms.values())) for _, _, terms in self.unread]).tolist()
        for (step, rate, terms), row in zip(self.unread, values, strict=True):
            self.log.add_step(step, rate, dict(zip(terms, row, strict=True)))
        self.unread.clear()

    def _report_progress(self) -> None:
        self._read_losses()
        assert self.log is not None
        loss = self.log.rows[-1]["loss"]
        rate = (self.step - self.first_step) / (time.monotonic() - self.started)
        left_s = (self.total - self.step) / max(rate, 1e-9)
        self.say(
            f"step {self.step}/{self.total}  loss {loss:.4f}  {rate * self.config.batch:.1f} examples/s  "
            f"{left_s / 60:.1f} min left"
        )

    def validate_and_save(self, finished: bool) -> None:
        """Write metrics, curves, the checkpoint and the weights; every file atomically."""
        if self.log is not None:
            self._read_losses()
            if isinstance(self.average.encoder, Autodecoder):
                self.average.encoder.update_mean()
            if self.config.holdout:
                scores = validate(self.average, self.data, self.config)
                self.log.add_validation(self.step, scores.iou, scores.miou)
            self.log.write()
            save_checkpoint(self.run_dir, Checkpoint(self.step, self.network, self.average, self.optimizer))
            offsets = choose_offsets(self.average, self.data, self.config) if finished else None
            save_model(self.model(offsets), self.run_dir / "weights.safetensors")
            self.say(f"saved at step {self.step}: {self.log.summary()}")
        if self.process.world > 1:
            dist.barrier()

    def model(self, offsets: Tensor | None = None) -> Model:
        """Model of the averaged network, class offsets in its last bias, with the header of its weights."""
        manifest = self.data.manifest
        network = self.average
        if offsets is not None:
            network = copy.deepcopy(network)  # the running average must stay what it is
            with torch.no_grad():
                network.decoder.head.bias[: len(offsets)] += offsets.to(self.device)
        provenance: dict[str, object] = {
            "scene": manifest["scene"],
            "source": manifest.get("source"),
            "data": manifest["settings"],
            "training_seed": manifest["seed"],
            "training_examples": manifest["examples"],
            "steps": self.step,
            "mereo": manifest["version"],
            "visible_m": self.data.visible_m,
            "class_offsets": None if offsets is None else offsets.tolist(),
            "recipe": self.config.to_dict(),
        }
        return Model(
            network=network,
            names=tuple(s["name"] for s in manifest["segments"]),
            colors=tuple(tuple(s["color"]) for s in manifest["segments"]),
            loss=self.config.loss,
            provenance=provenance,
            domain=self.data.domain(),
            nested=tuple((inner, outer) for inner, outer in manifest.get("nested", ())),
        )

    def resume(self) -> bool:
        """Load the checkpoint when there is one; returns whether there was."""
        step = load_checkpoint(self.run_dir, Checkpoint(0, self.network, self.average, self.optimizer))
        if step is None:
            return False
        self.step = self.first_step = step
        if self.log is not None:
            self.log.read_until(step)
        return True


def _parameter_groups(network: nn.Module, config: TrainConfig) -> list[dict[str, object]]:
    """Weight decay acts on matrices only: it would only slow biases and norms. Codes have a rate of their own."""
    named = dict(network.named_parameters())
    codes = [named.pop(CODES)] if CODES in named else []
    matrices = [p for p in named.values() if p.ndim >= 2]
    others = [p for p in named.values() if p.ndim < 2]
    peak = config.learning_rate
    groups: list[dict[str, object]] = [
        {"params": matrices, "weight_decay": config.weight_decay, "peak": peak},
        {"params": others, "weight_decay": 0.0, "peak": peak},
    ]
    if codes:
        groups.append({"params": codes, "weight_decay": 0.0, "peak": config.code_rate})
    return groups


def _seed(*numbers: int) -> int:
    """One 63-bit seed from several numbers."""
    return int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0] >> np.uint64(1))
