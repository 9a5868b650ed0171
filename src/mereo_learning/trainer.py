"""Loop of training, plain over batches; running the same command again continues where it stopped.

Everything random in step t is drawn from (seed, t), and which steps are validated depends on their number alone, so a
resumed run repeats an uninterrupted one exactly. Under ``torchrun`` each process takes its share of the batches that a
single one would have taken (docs/many-machines.md); process 0 writes.
"""

import copy
import math
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path

import torch
import torch.distributed as dist
from jaxtyping import Float, Int
from torch import Tensor, nn

from mereo.io.atomic_files import check_place
from mereo.io.object_storage import Place
from mereo.io.progress import Progress, progress
from mereo.models.config import Device
from mereo.models.device import compiling_pays, find_device, keep_freed_memory, pick_precision
from mereo.models.encoders import CODES, Autodecoder
from mereo.models.network import Network
from mereo.models.weights import save_model, trained_steps
from mereo.models.weights_place import WEIGHTS
from mereo_learning.config import TrainConfig
from mereo_learning.dataset import Batch, Dataset, Draws, seed_of, shuffled_index
from mereo_learning.losses import supervised_loss, with_known
from mereo_learning.metrics_log import MetricsLog
from mereo_learning.processes import (
    Process,
    agreed,
    connected,
    join_processes,
    leave_processes,
    meeting,
    share_statistics,
)
from mereo_learning.run_directory import (
    Checkpoint,
    claim_run,
    fit_config,
    load_checkpoint,
    save_checkpoint,
    seen_by,
    start_network,
    trained_model,
)
from mereo_learning.validation import choose_offsets, held_out, validate


def train(
    dataset_dir: Place,
    run_dir: Path,
    config: TrainConfig,
    *,
    device: Device = "auto",
    checkpoint_every_s: float = 120.0,
) -> Path:
    """Train on a generated dataset; returns the path of the weights (``run_dir/weights.safetensors``).

    ``run_dir`` receives config.json, metrics.csv, curves.png, checkpoint.safetensors and weights.safetensors. If it
    holds a checkpoint of the same settings, training continues from it, and what is missing of a finished run is
    written. Raises ``ValueError`` for other settings, and at the first step whose loss or gradient is not finite: what
    was saved before stays. ``ConnectionError`` where a process is lost.
    """
    check_place(run_dir, may_be_link=True)
    process = join_processes()
    _train(dataset_dir, run_dir, config, find_device(device, process.rank), checkpoint_every_s, process)
    leave_processes(process)
    return run_dir / WEIGHTS


def _train(
    dataset_dir: Place, run_dir: Path, config: TrainConfig, place: torch.device, save_every_s: float, process: Process
) -> None:
    data = Dataset.load(dataset_dir, place)
    config = fit_config(config, data)
    network = start_network(config, data)  # before anything is written: the weights it starts from may be unusable
    claim_run(run_dir, config, data, process)
    keep_freed_memory()
    trainer = Trainer(config, data, network, run_dir, process, place)
    if isinstance(network.encoder, Autodecoder):
        shown = len(held_out(data, config))
        trainer.say(f"the validation curve shows {shown} held-out examples, with codes found from their clouds")
    if trainer.resume():
        trainer.say(f"continuing from step {trainer.step} of {trainer.total}")
    last_save = time.monotonic()
    with trainer.showing() if process.is_main else nullcontext(), connected(process):
        for batch in trainer.batches():
            trainer.train_step(batch)
            trainer.validate()
            if trainer.step < trainer.total and agreed(process, time.monotonic() - last_save > save_every_s):
                trainer.save()
                last_save = time.monotonic()
        trainer.finish()


VALIDATIONS = 20
"""Held-out scores of a run, evenly over its steps: by the clock, a resumed run would have others."""


def steps_between(total: int) -> int:
    """Steps from one held-out score to the next, in a run of ``total``."""
    return math.ceil(total / VALIDATIONS)


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
        self.optimizer = torch.optim.AdamW(parameter_groups(self.network, config), lr=config.learning_rate, fused=True)
        self.examples = len(data) - config.holdout
        self.before = seen_by(config.init)  # now: the file may be gone when the weights are saved
        share = config.batch // process.world
        self.rows = slice(process.rank * share, (process.rank + 1) * share)
        self.total = max(1, math.ceil(config.epochs * self.examples / config.batch))
        self.step = self.saved_step = 0
        self.log = MetricsLog(run_dir, bool(data.further)) if process.is_main else None
        self.autocast = pick_precision(config.precision, device)
        self.module: nn.Module = share_statistics(self.network, process, device)
        if process.world > 1:
            self.module = nn.parallel.DistributedDataParallel(self.network)
        if config.compile == "on" or (config.compile == "auto" and compiling_pays(device, self.total)):
            self.module = torch.compile(self.module)  # type: ignore[assignment]
        self.first_step = 0
        self.shown: Progress | None = None

    def say(self, text: str) -> None:
        """Print a line, in process 0 only."""
        if self.process.is_main:
            print(text, flush=True)

    @contextmanager
    def showing(self) -> Iterator[None]:
        """Block in which the steps from here are shown."""
        with progress("train", self.total - self.step, "steps", each=self.config.batch) as self.shown:
            yield
        self.shown = None

    def _no_step(self) -> AbstractContextManager[None]:
        """Block whose time is no step's."""
        return nullcontext() if self.shown is None else self.shown.paused()

    def index(self, step: int) -> Int[Tensor, " b"]:
        """Numbers of the examples in the whole batch of a step."""
        return shuffled_index(step, self.examples, self.config.batch, self.config.seed)

    def batches(self) -> Iterator[Batch]:
        """Share of this process in every remaining batch."""
        config = self.config
        for step in range(self.step, self.total):
            index = self.index(step)[self.rows]
            draws = Draws.of(seed_of(config.seed, step, 0), config.batch, self.rows)
            batch = self.data.batch(index, config.network.points, config.queries, config.augment, draws)
            yield with_known(batch, self.process)

    def train_step(self, batch: Batch) -> None:
        """Take one optimizer step."""
        self.network.train()
        part = rate_share(self.config, self.step, self.total)
        for group in self.optimizer.param_groups:
            group["lr"] = group["peak"] * part
        torch.manual_seed(seed_of(self.config.seed, self.step, self.process.rank))  # for dropout
        self.optimizer.zero_grad(set_to_none=True)
        loss, terms = self._loss(batch)
        loss.backward()
        norm = clip_gradients(self.network, self.config.clip_norm)
        self.optimizer.step()
        self.step += 1
        update_average(self.average, self.network, self.step, self.config.ema_decay)
        self._record(self.config.learning_rate * part, {"norm": norm, **self._of_all({"loss": loss.detach(), **terms})})

    def _of_all(self, terms: dict[str, Tensor]) -> dict[str, Tensor]:
        """Means over all processes, which so stop at the same step, as DDP has made them of the gradients."""
        if self.process.world == 1:
            return terms
        means = torch.stack([value.float() for value in terms.values()]) / self.process.world
        dist.all_reduce(means)
        return dict(zip(terms, means, strict=True))

    def _loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of a batch, and its terms by name for the record."""
        with torch.autocast(self.device.type, self.autocast) if self.autocast else nullcontext():
            prediction, coarse = self.module(batch.cloud, batch.viewpoint, batch.positions, batch.index)
        loss, terms = supervised_loss(prediction, coarse, batch, self.config)
        if isinstance(self.network.encoder, Autodecoder):
            terms["code"] = self.network.encoder.length_penalty(self.network.encoder.code(batch.index)).mean()
            loss = loss + self.config.l1_weight * terms["code"]
        return loss, {name: value.detach() for name, value in terms.items()}

    def _record(self, rate: float, terms: dict[str, Tensor]) -> None:
        """Log a step; raises ``ValueError`` where it is not finite, in all processes, so nothing is saved of it."""
        losses = dict(zip(terms, torch.stack(list(terms.values())).tolist(), strict=True))
        norm = losses.pop("norm")
        if not (math.isfinite(norm) and math.isfinite(losses["loss"])):
            raise ValueError(self._divergence(self.step, losses["loss"], norm))
        if self.log is not None:
            self.log.add_step(self.step, rate, losses)
        if self.shown is not None:
            self.shown.advance(1, f"loss {losses['loss']:.4f}")

    def _divergence(self, step: int, loss: float, norm: float) -> str:
        """Sentence about a step that is not finite: where it is, what is left, and what may help."""
        what = f"the gradient's norm is {norm}" if math.isfinite(loss) else f"the loss is {loss}"
        batch = self.index(step - 1).tolist()
        examples = ", ".join(map(str, batch[:8])) + (", ..." if len(batch) > 8 else "")
        kept = (
            f"the checkpoint and weights of step {self.saved_step} are kept" if self.saved_step else "nothing is saved"
        )
        exact = " or --precision float32" if self.autocast else ""
        return (
            f"{what} in step {step} of {self.total}, on the examples {examples} of the data; training has diverged and "
            f"stops, {kept}: choose another --output and a --learning-rate below {self.config.learning_rate:g}{exact}, "
            "or check these examples"
        )

    def validate(self) -> None:
        """Score the averaged network on held-out examples, in the steps that have such scores."""
        due = self.step % steps_between(self.total) == 0 or self.step == self.total
        if not (due and self.config.holdout):
            return
        with self._no_step(), meeting(self.process):
            if self.log is None:
                return
            self._update_codes()
            scores = validate(self.average, self.data, self.config)
            self.log.add_validation(self.step, scores.iou, scores.miou)
            if self.data.further:
                scores = validate(self.average, self.data, self.config, further=True)
                self.log.add_validation(self.step, scores.iou, scores.miou, "sensor")
            self.say(f"held-out examples at step {self.step}: {self.log.summary()}")

    def save(self, finished: bool = False) -> None:
        """Write metrics, curves, the weights and the checkpoint; every file atomically.

        The checkpoint is the last, so whatever stops this leaves one from which the others are written again.
        """
        with self._no_step(), meeting(self.process):
            if self.log is not None:
                self._save(self.log, finished)
        self.saved_step = self.step

    def _save(self, log: MetricsLog, finished: bool) -> None:
        self._update_codes()
        log.write()
        offsets = choose_offsets(self.average, self.data, self.config) if finished else None
        model = trained_model(self.average, self.data, self.config, self.step, offsets, self.before)
        save_model(model, self.run_dir / WEIGHTS)
        save_checkpoint(self.run_dir, Checkpoint(self.step, self.network, self.average, self.optimizer))
        self.say(f"saved at step {self.step}: {log.summary()}")

    def finish(self) -> None:
        """Write all that a run leaves at its end, unless an earlier process has, which may have been killed before."""
        is_whole = self.log is not None and self.log.is_written(self.step)
        is_whole = is_whole and self.saved_step == self.step == trained_steps(self.run_dir / WEIGHTS)
        if not agreed(self.process, is_whole):
            if self.first_step == self.total:  # no step was taken in this process, so none was validated
                self.validate()
            self.save(finished=True)

    def _update_codes(self) -> None:
        if isinstance(self.average.encoder, Autodecoder):
            self.average.encoder.update_distribution()

    def resume(self) -> bool:
        """Load the checkpoint when there is one; returns whether there was."""
        step = load_checkpoint(self.run_dir, Checkpoint(0, self.network, self.average, self.optimizer), self.process)
        if step is None:
            return False
        if not all(value.isfinite().all() for value in self.network.parameters()):
            raise ValueError(
                f"the checkpoint of step {step} in {self.run_dir} holds numbers that are not finite, because that run "
                "diverged; it cannot be continued: choose another --output with a lower --learning-rate"
            )
        self.step = self.first_step = self.saved_step = step
        with meeting(self.process):
            if self.log is not None:
                self.log.read_until(step)
        return True


# --- optimization -----------------------------------------------------------------------------------------------------

# Optimization of a network in training: parameter groups, learning rates, gradient norm, averaged weights.


def parameter_groups(network: nn.Module, config: TrainConfig) -> list[dict[str, object]]:
    """Groups for the optimizer, each with its "peak" rate: weight decay acts on matrices only.

    It would only slow biases and norms. An autodecoder's codes have a rate of their own.
    """
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


def rate_share(config: TrainConfig, step: int, total: int) -> float:
    """Share of its peak, in [0, 1], that each learning rate has in a step, counted from 0, of ``total`` steps."""
    progress = step / total
    if progress < config.warmup:
        return (step + 1) / math.ceil(config.warmup * total)
    if config.schedule == "constant":
        return 1.0
    return 0.5 * (1 + math.cos(math.pi * (progress - config.warmup) / (1 - config.warmup)))


def clip_gradients(network: nn.Module, most: float) -> Float[Tensor, ""]:
    """Norm of all gradients together, which are then shortened to the norm ``most``; 0 leaves them as they are."""
    if most:
        return nn.utils.clip_grad_norm_(network.parameters(), most).float()
    return nn.utils.get_total_norm([p.grad for p in network.parameters() if p.grad is not None]).float()


@torch.no_grad()
def update_average(average: nn.Module, network: nn.Module, step: int, decay: float) -> None:
    """Move the exponential moving average of a network's weights, in place, to what they are after ``step`` steps."""
    # a young average follows closely, so that the random initialization is forgotten
    decay = min(decay, (1 + step) / (10 + step)) if decay else 0.0
    for mean, value in zip(average.state_dict().values(), network.state_dict().values(), strict=True):
        if mean.is_floating_point():
            mean.lerp_(value, 1 - decay)
        else:
            mean.copy_(value)
