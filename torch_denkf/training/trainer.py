"""Trains a filter, or a part of one, in stages; an interrupted training resumes exactly."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Literal

import torch
from torch import nn
from torchrl.checkpoint import GlobalRNGState
from torchrl.record.loggers.common import Logger

from torch_denkf._checks import check_count
from torch_denkf.compilation.lock import locked
from torch_denkf.deployment.progress import progress_bar
from torch_denkf.training.backups import back_up
from torch_denkf.training.checkpoint import check_settings, check_state, read_checkpoint, write_checkpoint
from torch_denkf.training.distributed import Processes
from torch_denkf.training.hooks import HookPoints
from torch_denkf.training.logs import RunLogs
from torch_denkf.training.stage import Stage, only_trainable, why_no_gain
from torch_denkf.training.update import Updates, seed_update

__all__ = ["FilterTrainer"]

_LOG = logging.getLogger("torch_denkf")
_VALIDATION = 2**32 - 1  # stage number for the seed of validations


class FilterTrainer(HookPoints):
    """Runs :class:`Stage` after :class:`Stage` on one model, validates, and keeps the best.

    torchrl's ``Trainer`` steps through a collector, has one loss and one optimiser, and does not resume exactly. This
    is a separate loop, therefore, which works with torchrl's losses, loggers and hooks
    (:class:`~torch_denkf.training.hooks.HookPoints`).

    A stage is validated before its first update, every ``validate_every`` updates and after its last. The next stage
    starts from the best parameters of the one before, and the model ends with the best of the last stage. A stage that
    lowered the monitored error by less than 1 % logs a warning with likely causes.

    **Resuming.** ``fit`` continues from ``out/last.pt`` if it exists. After a kill at any point, parameters and CSV
    logs equal those of an uninterrupted run exactly, on the same machine and number of threads; so do the checkpoint
    files, unless tensorboard's files, which are named after the time, are among the logs. On a GPU this needs
    deterministic kernels (``torch.use_deterministic_algorithms``). The model's modules must not have a state outside of
    their ``state_dict``, and a sampler none at all. A finished training is loaded, not repeated, with a message of the
    logger ``"torch_denkf"``. Without ``last.pt``, other files of an earlier run are moved to ``out/earlier-1``. One
    process at a time trains in ``out``.

    **Several processes.** ``torchrun --nproc_per_node=2 script.py``: each process samples with another generator, and
    the gradients are averaged, which equals one batch of twice the size if the loss is a mean over equally many
    elements in each. The first process validates, logs and writes; all return the same.

    Args:
        model: module to train, with the parameters of all stages.
        stages: the stages, in order.
        out: folder of ``last.pt``, ``best_<stage>.pt`` (read them with :func:`read_checkpoint`; ``["model"]`` is the
            model's state dict) and ``logs/``.
        validate: returns errors on held-out data, ``{name: value}``. It is called without gradients, with the model in
            ``eval()`` mode, and with the same seed each time.
        monitor: name of the error to minimise; may be left out if ``validate`` returns only one.
        validate_every: updates between validations.
        save_every: updates between checkpoints.
        log_every: updates between logs of their means, ``<stage>/<term>``; validations are logged as
            ``<stage>/validation/<name>``, with the number of updates in the stage as step.
        loggers: see :class:`RunLogs`.
        seed: seed of all random numbers of the training, at least 0. The caller seeds the model's initial parameters.
        device: by default the GPU if there is one.
        keep: ``"best"``, or ``"last"``: stages begin and end with the parameters of the last update.
        max_skipped: largest number of successive updates that are skipped because the loss or its gradient is not
            finite; more are an error. The first one of a stage is logged, with the entries of its batch that are not
            finite.
        progress: whether to show a progress bar, or without a terminal a line every ten seconds.

    Raises:
        ValueError: for stages without parameters, with equal names, or with parameters outside of the model.

    Example:
        >>> from tempfile import mkdtemp
        >>> from tensordict import TensorDict
        >>> net = nn.Linear(1, 1)  # learns 3 x + 1
        >>> line = lambda x: TensorDict({"x": x, "y": 3 * x + 1}, x.shape[:1])
        >>> error = lambda batch: (net(batch["x"]) - batch["y"]).square().mean()
        >>> fit = Stage(
        ...     "fit",
        ...     loss=lambda batch: {"loss_fit": error(batch)},
        ...     sample=lambda generator, length: line(torch.rand(32, 1, generator=generator)),
        ...     updates=200,
        ...     lr=0.2,
        ... )
        >>> held_out = line(torch.linspace(0, 1, 11).unsqueeze(-1))
        >>> trainer = FilterTrainer(
        ...     net, [fit], out=mkdtemp(), validate=lambda: {"mse": float(error(held_out))}, device="cpu"
        ... )
        >>> best = trainer.fit()["fit"]
        >>> best["value"] < 1e-4, best["path"].name
        (True, 'best_fit.pt')
    """

    def __init__(
        self,
        model: nn.Module,
        stages: Sequence[Stage],
        *,
        out: Path | str,
        validate: Callable[[], Mapping[str, float]] | None = None,
        monitor: str | None = None,
        validate_every: int = 100,
        save_every: int = 100,
        log_every: int = 10,
        loggers: Iterable[str | Logger] = ("csv",),
        seed: int = 0,
        device: torch.device | str | None = None,
        keep: Literal["best", "last"] = "best",
        max_skipped: int = 10,
        progress: bool = True,
    ):
        super().__init__()
        names = [stage.name for stage in stages]
        if not names or len(set(names)) < len(names):
            raise ValueError(f"A training needs stages, each with a name of its own; got {names}.")
        for name, value in {"validate_every": validate_every, "save_every": save_every, "log_every": log_every}.items():
            check_count(name, value, cure="It is a number of updates")
        check_count("max_skipped", max_skipped, least=0, cure="It is a number of updates")
        check_count("seed", seed, least=0)
        if keep not in ("best", "last"):
            raise ValueError(f'keep is "best" or "last"; got {keep!r}.')
        self.model, self.stages, self.out = model, list(stages), Path(out)
        self.validate, self.monitor = validate, monitor
        self.validate_every, self.save_every, self.log_every = validate_every, save_every, log_every
        self.seed, self.keep, self.max_skipped, self.progress = seed, keep, max_skipped, progress
        self.processes = Processes(device)
        for module in (model, *(stage.loss for stage in stages)):  # losses may have buffers
            if isinstance(module, nn.Module):
                module.to(self.processes.device)
        self._settings = {
            "seed": seed,
            "processes": self.processes.world_size,
            "stages": [stage.settings(model) for stage in stages],
        }
        self._logs = RunLogs(self.out / "logs", loggers if self.processes.is_main else ())
        self._results: dict[str, dict[str, Any]] = {}
        self._best: dict[str, Any] | None = None
        self._last_metrics: dict[str, float] = {}
        self._first: float | None = None  # the monitored error before the stage's first update

    @property
    def last_checkpoint(self) -> Path:
        """Returns the file from which a training is resumed."""
        return self.out / "last.pt"

    def fit(self, *, resume: bool = True) -> dict[str, dict[str, Any]]:
        """Trains to the end, from a checkpoint if there is one.

        Args:
            resume: ``False`` removes an earlier run's checkpoints and logs from ``out`` and restarts.

        Returns:
            for each stage: ``value`` of the monitored error (``None`` without validation) at its best ``update``, all
            ``metrics`` there, the ``path`` of that checkpoint, and the number of ``skipped`` updates.

        Raises:
            ValueError: if the checkpoint is damaged, or of another training; the message names the file.
            OSError: if another process trains in ``out``, or it cannot be written to; the message names the folder and
                the process, or the file and the free space.
            FloatingPointError: if too many updates in a row are not finite; the message names stage and update.
        """
        alone = locked(self.out, ".training", "is training in it") if self.processes.is_main else nullcontext()
        with alone:
            return self._fit(resume)

    def _fit(self, resume: bool) -> dict[str, dict[str, Any]]:
        state = self.processes.share(self._open(resume) if self.processes.is_main else {})
        self._load_model(state["model"], str(self.last_checkpoint))
        self._results, self._best = state["results"], state["best"]
        self._last_metrics, self._first = state["last_metrics"], state["first"]
        self._load_hook_state(state["hooks"])
        randomness = GlobalRNGState().state_dict()  # later random numbers must not depend on a resumption
        try:
            for number in range(state["stage"], len(self.stages)):
                self._run_stage(number, state["updates"], state["update"])
                state.update(updates=None, update=0)
        finally:
            self._logs.close()
            GlobalRNGState().load_state_dict(randomness)
        results = {name: {**result, "path": self.out / result["path"]} for name, result in self._results.items()}
        return {stage.name: results[stage.name] for stage in self.stages}

    # ------------------------------------------------------------------------------------------------ one stage

    def _run_stage(self, number: int, saved: dict | None, done: int) -> None:
        stage = self.stages[number]
        updates = Updates(stage, stage.groups(self.model), self.processes)
        shown = self.progress and self.processes.is_main
        bar = progress_bar(stage.name, stage.updates, done, shown=shown)
        with only_trainable(self.model, updates.parameters), bar:
            if saved is None:
                self._best = None
                self._validate(stage, 0)
                self._save(number, 0, updates)
            else:
                updates.load_state_dict(saved)
            for update in range(done, stage.updates):
                self._update(number, updates, update, bar)
                made = update + 1
                last = made == stage.updates
                if made % self.validate_every == 0 or last:
                    self._validate(stage, made)
                if made % self.save_every == 0:
                    self._save(number, made, updates)
        self._finish(number, updates)

    def _update(self, number: int, updates: Updates, update: int, bar: Any) -> None:
        stage, length = updates.stage, updates.stage.length(update)
        generator = seed_update(self.seed, number, update, self.processes.rank)
        logged = (update + 1) % self.log_every == 0 or update + 1 == stage.updates
        self._call_hooks("pre_optim_steps")
        batch = self._hooked_batch(stage.sample(generator, length).to(self.processes.device))
        values = self._hooked_values("pre_steps_log", batch) if logged else {}
        if not updates.step(batch) and updates.skipped == 1:
            _LOG.warning(
                "Stage %r, update %d is left out, as are all whose loss or gradient is not finite; they are counted as "
                "skipped. %s",
                stage.name,
                update + 1,
                updates.cause,
            )
        self._call_hooks("post_optim")
        if updates.in_a_row > self.max_skipped:
            raise FloatingPointError(
                f"Stage {stage.name!r}, update {update + 1}: the loss or its gradient was not finite in "
                f"{updates.in_a_row} updates in a row. Look for NaN in the batches; lower lr or clip. The last save, "
                f"{self.last_checkpoint}, is sound. {updates.cause}".rstrip()
            )
        if logged:
            values |= updates.summary() | ({} if length is None else {"length": length})
            values |= self._hooked_values("post_optim_log", batch)
            self._log(stage, values, update + 1)
            shown = {k: v for k, v in values.items() if k.startswith("loss")} | self._last_metrics
            bar.set_postfix({k: f"{v:.3g}" for k, v in shown.items()}, refresh=False)
        bar.update()

    def _validate(self, stage: Stage, made: int) -> None:
        validate = stage.validate or self.validate
        if validate is None or not self.processes.is_main:
            return
        training = [module for module in self.model.modules() if module.training]
        self.model.eval()
        seed_update(self.seed, _VALIDATION, 0)  # the next update sets its own seed
        try:
            with torch.no_grad():
                metrics = {name: float(value) for name, value in validate().items()}
        finally:
            for module in training:
                module.training = True
        monitor = stage.monitor or self.monitor or (next(iter(metrics)) if len(metrics) == 1 else None)
        if monitor not in metrics:
            raise KeyError(f"Stage {stage.name!r}: monitor={monitor!r} is none of {sorted(metrics)}; set monitor=...")
        self._log(stage, {f"validation/{name}": value for name, value in metrics.items()}, made)
        self._last_metrics = metrics
        if made == 0:
            self._first = metrics[monitor]
        if self.keep == "last" or metrics[monitor] < (float("inf") if self._best is None else self._best["value"]):
            self._set_best(stage, made, metrics[monitor], metrics)

    def _set_best(self, stage: Stage, made: int, value: float | None, metrics: dict[str, float]) -> None:
        self._best = {
            "stage": stage.name,
            "update": made,
            "value": value,
            "metrics": metrics,
            "model": self._model_on_cpu(),
        }
        write_checkpoint(self.out / f"best_{stage.name}.pt", self._best)

    def _finish(self, number: int, updates: Updates) -> None:
        stage = updates.stage
        if self.processes.is_main and self._best is None:  # no validation, or never a finite value
            self._set_best(stage, stage.updates, None, {})
        best = self.processes.share(self._best or {})
        self._load_model(best["model"], f"best_{stage.name}.pt")
        result = {key: best[key] for key in ("value", "update", "metrics")}
        self._results[stage.name] = {**result, "path": f"best_{stage.name}.pt", "skipped": updates.skipped}
        if self.processes.is_main and self._first is not None and result["value"] is not None:
            said = why_no_gain(stage, self._first, result["value"], result["update"])
            if said:
                _LOG.warning(said)
        if number + 1 == len(self.stages):
            self._save(number + 1, 0, None)

    def _log(self, stage: Stage, values: Mapping[str, float], made: int) -> None:
        self._logs.log({f"{stage.name}/{name}": value for name, value in values.items()}, made)

    # ---------------------------------------------------------------------------------------------- checkpoints

    def _save(self, number: int, made: int, updates: Updates | None) -> None:
        if self.processes.is_main:
            state = {"settings": self._settings, "stage": number, "update": made, "logs": self._logs.mark()}
            state |= {"model": self.model.state_dict(), "updates": None if updates is None else updates.state_dict()}
            state |= {"results": self._results, "best": self._best, "last_metrics": self._last_metrics}
            state |= {"first": self._first}
            write_checkpoint(self.last_checkpoint, {**state, "hooks": self._hook_state()})

    def _open(self, resume: bool) -> dict[str, Any]:
        self.out.mkdir(parents=True, exist_ok=True)
        if resume and self.last_checkpoint.exists():
            state = read_checkpoint(self.last_checkpoint)
            check_state(self.last_checkpoint, state)
            check_settings(self.last_checkpoint, state["settings"], self._settings, state["stage"])
            if state["best"] is not None:  # the file may be from later validations, which will be repeated
                write_checkpoint(self.out / f"best_{state['best']['stage']}.pt", state["best"])
            self._logs.open(state["logs"])
            if state["stage"] == len(self.stages):
                _LOG.warning(
                    "The training in %s is finished: its result is read and nothing is trained. Start again with "
                    "fit(resume=False), or give another out.",
                    self.out,
                )
            return state
        if self.last_checkpoint.exists():  # the caller wants to start again
            for file in (self.last_checkpoint, *self.out.glob("best_*.pt")):
                file.unlink(missing_ok=True)
        else:
            back_up(self.out, [*self.out.glob("best_*.pt"), *self._logs.files()])
        self._logs.open({})
        state = {
            "stage": 0,
            "update": 0,
            "updates": None,
            "results": {},
            "best": None,
            "last_metrics": {},
            "first": None,
            "hooks": {},
        }
        return {**state, "hooks": {}, "model": self._model_on_cpu()}

    def _model_on_cpu(self) -> dict[str, torch.Tensor]:
        return {name: tensor.detach().cpu().clone() for name, tensor in self.model.state_dict().items()}

    def _load_model(self, state: Mapping[str, torch.Tensor], source: str) -> None:
        try:
            self.model.load_state_dict(state)
        except RuntimeError as error:
            raise ValueError(f"{source} does not fit the model to be trained: {error}") from error
