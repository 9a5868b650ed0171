"""Loop of training, plain over batches; running the same command again continues where it stopped.

Everything random in step t is drawn from (seed, t), and which steps are validated depends on their number alone, so a
resumed run repeats an uninterrupted one exactly. Under ``torchrun`` each process takes its share of the batches that a
single one would have taken (docs/clusters.md); process 0 writes.
"""

import copy
import math
import time
from collections.abc import Generator
from contextlib import closing, nullcontext
from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor, nn

from mereo.io.atomic_files import check_place
from mereo.io.object_storage import Place
from mereo.models.config import Device
from mereo.models.device import compiling_pays, find_device, keep_freed_memory, pick_precision
from mereo.models.encoders.encoding import Autodecoder
from mereo.models.network import Network
from mereo.models.weights import save_model, trained_steps
from mereo.models.weights_place import WEIGHTS
from mereo.training.batch_normalization import adapt_momentum, share_statistics
from mereo.training.batches import Batch, Draws
from mereo.training.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from mereo.training.config import TrainConfig
from mereo.training.data_source import TrainingData, open_data
from mereo.training.examples_seen import seen_by
from mereo.training.going_nowhere import EXAMPLES, ConstantAnswer, Judge
from mereo.training.losses import supervised_loss, with_known
from mereo.training.metrics_log import MetricsLog
from mereo.training.optimization import clip_gradients, parameter_groups, rate_share, update_average
from mereo.training.orders import seed_of
from mereo.training.processes import Process, agreed, connected, join_processes, leave_processes, meeting
from mereo.training.run_directory import claim_run, fit_config, start_network, trained_model
from mereo.training.steps_shown import StepsShown, steps_between
from mereo.training.streaming import StreamingDataset
from mereo.training.validation import choose_offsets, held_out, validate


def train(
    dataset_dir: Place,
    run_dir: Path,
    config: TrainConfig,
    *,
    device: Device = "auto",
    checkpoint_every_s: float = 120.0,
) -> Path:
    """Train on a generated dataset; returns the path of the weights (``run_dir/weights.safetensors``).

    ``run_dir`` receives config.json, metrics.csv, curves.png, checkpoint.safetensors and weights.safetensors, and
    survey.json where examples are streamed. If it holds a checkpoint of the same settings, training continues from it,
    and what is missing of a finished run is written. Raises ``ValueError`` for other settings, and at the first step
    whose loss or gradient is not finite: what was saved before stays. ``ConnectionError`` where a process is lost.
    """
    check_place(run_dir, may_be_link=True)
    process = join_processes()
    _train(dataset_dir, run_dir, config, find_device(device, process.rank), checkpoint_every_s, process)
    leave_processes(process)
    return run_dir / WEIGHTS


def _train(
    dataset_dir: Place, run_dir: Path, config: TrainConfig, place: torch.device, save_every_s: float, process: Process
) -> None:
    config, data = open_data(dataset_dir, run_dir, config, place, process)
    config = fit_config(config, data)
    network = start_network(config, data)  # before anything is written: the weights it starts from may be unusable
    claim_run(run_dir, config, data, process)
    if isinstance(data, StreamingDataset):
        data = data.surveyed(run_dir, process)
    keep_freed_memory()
    trainer = Trainer(config, data, network, run_dir, process, place)
    if isinstance(network.encoder, Autodecoder):
        shown = len(held_out(data, config))
        trainer.say(f"the validation curve shows {shown} held-out examples, with codes found from their clouds")
    if trainer.resume():
        trainer.say(f"continuing from step {trainer.step} of {trainer.total}")
    last_save = time.monotonic()
    with trainer.shown.showing(trainer.step) if process.is_main else nullcontext(), connected(process):
        with closing(trainer.batches()) as batches:
            for batch in batches:
                trainer.train_step(batch)
                trainer.validate()
                if trainer.step < trainer.total and agreed(process, time.monotonic() - last_save > save_every_s):
                    trainer.save()
                    last_save = time.monotonic()
        trainer.finish()


READ_EVERY = 20
"""Steps after which losses are read on a device where reading waits."""


class Trainer:
    """Run of a training, with its mutable state: network, optimizer, averaged weights, step."""

    def __init__(
        self,
        config: TrainConfig,
        data: TrainingData,
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
        self.order = data.order(self.examples, config.batch, config.seed, process.world)
        share = config.batch // process.world
        self.rows = slice(process.rank * share, (process.rank + 1) * share)
        self.total = max(1, math.ceil(config.epochs * self.examples / config.batch))
        self.step = self.saved_step = 0
        self.log = MetricsLog(run_dir, bool(data.further)) if process.is_main else None
        self.unread: list[tuple[int, float, dict[str, Tensor]]] = []
        self.autocast = pick_precision(config.precision, device)
        adapt_momentum(self.network, config.accumulate)
        self.module: nn.Module = share_statistics(self.network, process, device)
        if process.world > 1:
            self.module = nn.parallel.DistributedDataParallel(self.network)
        if config.compile == "on" or (config.compile == "auto" and compiling_pays(device, self.total)):
            self.module = torch.compile(self.module)  # type: ignore[assignment]
        constant = ConstantAnswer.of(*data.first_queries(EXAMPLES), config.supervision.labels)
        self.judge = Judge(constant, self.total)
        self.first_step = 0
        self.shown = StepsShown(config, self.total, len(held_out(data, config)) * (2 if data.further else 1))

    def say(self, text: str) -> None:
        """Print a line, in process 0 only."""
        if self.process.is_main:
            print(text, flush=True)

    def batches(self) -> Generator[Batch, None, None]:
        """Share of this process in every remaining batch."""
        config = self.config
        for data, index in self.data.pieces(self.order, range(self.step, self.total), self.rows):
            draws = Draws.of(seed_of(config.seed, self.step, 0), config.batch, self.rows)
            batch = data.batch(index, config.network.points, config.queries, config.augment, draws)
            yield with_known(batch, self.process, config.accumulate)

    def train_step(self, batch: Batch) -> None:
        """Take one optimizer step."""
        self.network.train()
        part = rate_share(self.config, self.step, self.total)
        for group in self.optimizer.param_groups:
            group["lr"] = group["peak"] * part
        torch.manual_seed(seed_of(self.config.seed, self.step, self.process.rank))  # for dropout
        self.optimizer.zero_grad(set_to_none=True)
        terms = self._gradients(batch)
        norm = clip_gradients(self.network, self.config.clip_norm)
        self.optimizer.step()
        self.step += 1
        update_average(self.average, self.network, self.step, self.config.ema_decay)
        values = {"norm": norm, **self._of_all(terms)}
        self.unread.append((self.step, self.config.learning_rate * part, values))
        if self.device.type == "cpu" or self.step % READ_EVERY == 0 or self.step == self.total:
            self._read_losses()  # on a CPU that waits for nothing

    def _gradients(self, batch: Batch) -> dict[str, Tensor]:
        """Add up the gradients of a batch's parts, with the last one over all processes; returns their mean terms."""
        parts = batch.parts(self.config.accumulate)
        found: list[dict[str, Tensor]] = []
        for part in parts:
            alone = self.process.world > 1 and len(found) + 1 < len(parts)
            with self.module.no_sync() if alone else nullcontext():  # type: ignore[operator]
                loss, terms = self._loss(part)
                (loss / len(parts) if len(parts) > 1 else loss).backward()
            found.append({"loss": loss.detach(), **terms})
        return found[0] if len(found) == 1 else {n: torch.stack([row[n] for row in found]).mean(0) for n in found[0]}

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

    def _read_losses(self) -> None:
        """Log the steps since the last call, all with one copy from the device, which would wait at every step.

        Whoever saves calls it first, so nothing is saved of a step whose loss or gradient is not finite, or after it.
        All processes call it at the same steps, and raise the same.
        """
        if not self.unread:
            return
        values = torch.stack([torch.stack(list(terms.values())) for _, _, terms in self.unread]).tolist()
        for (step, rate, terms), row in zip(self.unread, values, strict=True):
            losses = dict(zip(terms, row, strict=True))
            norm = losses.pop("norm")
            if not (math.isfinite(norm) and math.isfinite(losses["loss"])):
                raise ValueError(self._divergence(step, losses["loss"], norm))
            if self.log is not None:
                self.log.add_step(step, rate, losses)
        self.unread.clear()
        self.shown.took(self.step, losses["loss"])

    def _divergence(self, step: int, loss: float, norm: float) -> str:
        """Sentence about a step that is not finite: where it is, what is left, and what may help."""
        what = f"the gradient's norm is {norm}" if math.isfinite(loss) else f"the loss is {loss}"
        batch = self.order.index(step - 1).tolist()
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
        self._read_losses()
        with self.shown.apart(self.shown.scored), meeting(self.process):
            if self.log is not None:
                self._validate(self.log)

    def _validate(self, log: MetricsLog) -> None:
        self._update_codes()
        scores = validate(self.average, self.data, self.config)
        log.add_validation(self.step, scores.iou, scores.miou)
        if self.data.further:
            scores = validate(self.average, self.data, self.config, further=True)
            log.add_validation(self.step, scores.iou, scores.miou, "sensor")
        self.say(f"held-out examples at step {self.step}: {log.summary()}{self.judge.doubt(log.rows)}")

    def save(self, finished: bool = False) -> None:
        """Write metrics, curves, the weights and the checkpoint; every file atomically.

        The checkpoint is the last, so whatever stops this leaves one from which the others are written again.
        """
        self._read_losses()
        with self.shown.apart(), meeting(self.process):
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
        self.say(f"saved at step {self.step}: {log.summary()}{self.judge.doubt(log.rows)}")

    def finish(self) -> None:
        """Write all that a run leaves at its end, unless an earlier process has, which may have been killed before."""
        there = self.log is not None and self.log.is_written(self.step)
        there = there and self.saved_step == self.step == trained_steps(self.run_dir / WEIGHTS)
        if not agreed(self.process, there):
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
