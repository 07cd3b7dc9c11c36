"""The trainer of `ns-train sadgs`. It plans, saves and resumes a run, and ends a failed one with one sentence."""

from __future__ import annotations

import copy
import math
import os
import shlex
import signal
import time
from pathlib import Path
from typing import Any

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sadgs_ns import events, interrupts
from sadgs_ns.errors import InputError, RunError, WriteError, reason
from sadgs_ns.interrupts import Interrupted, Interrupts
from sadgs_ns.kernels import use_triton
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.kernels_ahead import compile_ahead
from sadgs_ns.training.kernels_ahead.compilation import compile_kernels
from sadgs_ns.training.pipeline import SadgsPipeline
from sadgs_ns.training.run import checkpoints, processes, run_folder
from sadgs_ns.training.run.preparation import prepare_run
from sadgs_ns.training.run.processes import Peers
from sadgs_ns.training.run.progress import next_commands, note, remove_tables
from sadgs_ns.training.run.resume import Resumption
from sadgs_ns.training.run.step_requests import StepRequests
from sadgs_ns.training.step.cuda_graphs import GraphedSteps
from sadgs_ns.training.step.optimizers import SadgsOptimizers
from sadgs_ns.training.step.train_step import StepResult, ViewGroup, training_step

_LESS_MEMORY = (
    "lower --pipeline.model.strategy.max-gaussians or --pipeline.views-per-iteration, or take smaller images "
    "(`--downscale-factor 2` after `nerfstudio-data` or `colmap`), or several devices (`--share-always True`)"
)
_NOTHING_DONE = "stopped before an iteration was done; the same command starts again"
_SAVING_SHARE = 0.01  # Saving may take at most this share of the time between two checkpoints by the clock


class SadgsTrainer(Trainer):
    """A trainer for one or several processes, which call the same methods; rank 0 prints and writes files."""

    config: SadgsTrainerConfig
    pipeline: SadgsPipeline
    optimizers: SadgsOptimizers

    def __init__(self, config: SadgsTrainerConfig, local_rank: int = 0, world_size: int = 1) -> None:
        interrupts.redirect_on_broken_pipe(CONSOLE)
        config.check()
        # Only fields of this copy itself are changed; all that they refer to is the caller's.
        config = copy.copy(config)  # Several processes agree on the time stamp, which `config.yml` must not hold.
        if config.machine.device_type == "cuda" and local_rank == 0:
            compile_ahead.begin()
        self.world, local_rank = processes.join(config, local_rank)
        self._peers: Peers | None = None  # There are some if several processes train.
        if not self.world.is_single:
            self._peers = Peers(self.world)
            with processes.local_rank_zero_first(self.world, local_rank):
                use_triton(self.world.device)  # This compiles a kernel.
        self._requested_vis: Any = config.vis
        # nerfstudio would wrap the pipeline for several devices in its own way.
        super().__init__(config, local_rank, world_size=1)
        self.graphed: GraphedSteps | None = None  # Replays steps as CUDA graphs, where that is possible.
        self._resumed: Resumption | None = None  # The checkpoint to go on from, until its optimizers are loaded
        self._stepping = False  # Whether a step has begun and is not done
        self._completed_step = -1
        self._saved_step = -1  # The last completed step that a checkpoint holds
        self._save_due = math.inf  # When a checkpoint is due, by the monotonic clock in seconds
        self._interrupts = Interrupts(waiting=self._waits_for_user, started=not self.world.is_single)

    def _waits_for_user(self) -> bool:
        """Tell whether nerfstudio waits for the viewer's user, as it does while a run is paused or done."""
        return self.training_state != "training" and not self._stepping

    def setup(self, *args: Any, **kwargs: Any) -> None:
        """Load data, model and checkpoint, and compile kernels, or raise InputError, RunError, SystemExit on SIGINT."""
        try:
            super().setup(*args, **kwargs)
            plan = self.pipeline.model.plan
            if processes.is_rank_zero():
                plan.write(self.base_dir)
            events.report("training begins", iterations=plan.iterations)
            after_run = [TrainingCallbackLocation.AFTER_TRAIN]
            self.callbacks.append(TrainingCallback(after_run, lambda step: self._print_next_commands()))
            with processes.local_rank_zero_first(self.world, self.local_rank):
                compile_kernels(self.pipeline, self.optimizers.optimizers)
            if self._can_replay_steps():
                self.graphed = GraphedSteps(self.pipeline.model)
        except RuntimeError as error:
            self._explain(error, "is too small to start", _LESS_MEMORY, _NOTHING_DONE)
            raise
        except KeyboardInterrupt:
            note(f"SIGINT: {_NOTHING_DONE}.")
            raise SystemExit(128 + signal.SIGINT) from None

    def _can_replay_steps(self) -> bool:
        """Tell whether steps of this run can be CUDA graphs: the host must not wait in them."""
        model = self.pipeline.model
        if not self.config.cuda_graphs:
            return False
        return self.world.is_single and model.backend == "triton" and model.tile_forecast is not None

    def _explain(self, error: RuntimeError, memory: str, remedy: str, kept: str) -> None:
        """Raise RunError if the GPU's memory was full, or if another process has ended; else return.

        Args:
            error: What was raised.
            memory: The words after "The GPU's memory", such as "was full at iteration 7".
            remedy: What to do if the memory was full.
            kept: What is saved if another process ended.
        """
        if isinstance(error, torch.cuda.OutOfMemoryError):
            first_sentences = reason(error).split(". ")[:2]  # Torch has many more.
            asked_for = ". ".join(first_sentences).rstrip(".")
            raise RunError(f"The GPU's memory {memory} ({asked_for}): {remedy}.") from error
        if not isinstance(error, RunError) and self._peers is not None and self._peers.ended():
            raise RunError(f"Another process of the run ended, and this one with it: {kept}.") from error

    def _print_next_commands(self) -> None:
        """Print the commands for a finished run below nerfstudio's box, unless the run diverged."""
        if self.pipeline.diverged:
            return
        gaussians = self.pipeline.model.num_gaussians
        held_out = len(self.pipeline.datamanager.eval_dataset)
        note(next_commands(self.base_dir / "config.yml", gaussians, held_out))
        events.report("training ends", gaussians=gaussians)

    def _load_checkpoint(self) -> None:
        """Load the checkpoint's optimizers; `setup_optimizers` has loaded its Gaussians."""
        if self._resumed is None:
            return super()._load_checkpoint()
        self._resumed.load_optimizers(self.optimizers, self.config.load_scheduler)
        self._resumed = None

    def setup_optimizers(self) -> SadgsOptimizers:
        """Prepare the run, as `prepare_run` says, and build its optimizers."""
        run = prepare_run(self.config, self.pipeline, self.world, self._peers)
        self.world = run.world
        self._peers = run.peers
        self._resumed = run.resumed
        self._start_step = run.start_step
        self.config.max_num_iterations = run.plan.iterations  # nerfstudio's loop and table read it.
        return SadgsOptimizers(run.plan.optimizers(self.config.optimizers), self.pipeline.get_param_groups())

    def train(self) -> None:
        """Train up to `max_num_iterations` in all; nerfstudio 1.1.5 would train that many more after resuming.

        Raises RunError if memory is full or the run has diverged; InputError if an image cannot be decoded any more;
        WriteError if a checkpoint or log could not be written; SystemExit after a signal, once a checkpoint is saved.
        """
        total = self.pipeline.model.plan.iterations
        self.step: int = max(self._start_step - 1, 0)  # It names the checkpoint if nothing is left to do.
        self._completed_step = self._start_step - 1
        self._saved_step = self._start_step - 1
        self.config.max_num_iterations = max(total - self._start_step, 0)
        if self._start_step >= total:
            writer.GLOBAL_BUFFER["step"] = self.step  # Only an iteration would set it.
            note(
                f"This run is finished after {self._start_step} iterations: --max-num-iterations of more than "
                f"{self._start_step} trains on."
            )
        self._schedule_save(0.0)
        events.report("loop begins")
        try:
            self._train_until_interrupted(total)
        except InputError as error:  # An image that is decoded ahead of its step is gone or damaged.
            problem = str(error).rstrip(".")
            raise InputError(f"{problem}; {self._how_to_resume}.") from error
        except RuntimeError as error:
            memory = f"was full at iteration {self.step} with {self.pipeline.model.num_points} Gaussians"
            self._explain(error, memory, f"{_LESS_MEMORY}; {self._how_to_resume}", self._how_to_resume)
            raise
        finally:
            self.config.max_num_iterations = total
            self.pipeline.views.close()
            remove_tables()
            run_folder.release(self.base_dir)
        processes.leave()

    def _train_until_interrupted(self, total: int) -> None:
        """Train as nerfstudio does, unless a signal (SystemExit) or a logger's error stops the run, which saves it."""
        with self._interrupts:
            try:
                if not self.world.is_single:  # Making it as nerfstudio does fails if another process is as fast.
                    self.base_dir.mkdir(parents=True, exist_ok=True)
                super().train()
                self._stop_if_diverged()
            except Interrupted as interrupted:
                self._stop(interrupted, total)
            except OSError as error:
                if error.errno is None:  # This is a WriteError, or not from the disk.
                    raise
                # A logger could not write, perhaps to another disk, or to a terminal whose SIGHUP is on its way.
                if not self._stepping and self._completed_step > self._saved_step and self.world.is_single:
                    self.save_checkpoint(self._completed_step)
                raise WriteError(Path(os.fsdecode(error.filename or self.base_dir)), error) from error

    @property
    def _how_to_resume(self) -> str:
        """The part of a sentence that says how the run goes on after an error between two checkpoints."""
        if not any(self.checkpoint_dir.glob("*.ckpt")):
            return "this run has made no checkpoint yet"
        return f"what the last checkpoint holds goes on with --load-dir {self.checkpoint_dir}"

    def train_iteration(self, step: int) -> tuple[Tensor, dict[str, Tensor], dict[str, Any]]:
        """Train on the views of a step, and return the loss, the losses by name, and metrics.

        A signal stops the run only after the step, in `_update_viewer_state`.
        """
        self._stepping = True
        # In the step, several processes agree whether to save or stop after it.
        self.world.flags_in = 0
        self.world.flags_out = self._own_requests().encode()
        model = self.pipeline.model
        if self.graphed is not None and model.tile_forecast is not None:
            can_replay = self.graphed.prepare(model.plan.views_per_iteration)
            model.tile_forecast.round_to_powers = can_replay  # Each capacity needs a graph of its own.
        groups = self.pipeline.next_views(step)
        result = self._train_on(groups)
        self.pipeline.record_step(step, groups, result)
        self.optimizers.scheduler_step_all(step)
        metrics: dict[str, Any] = {"psnr": result.psnr, "gaussian_count": model.num_gaussians}
        return result.loss, {"main_loss": result.loss}, metrics

    def _train_on(self, groups: list[ViewGroup]) -> StepResult:
        """Update all parameters by the loss of a step's views, with a CUDA graph if there is one for such a step."""
        model = self.pipeline.model
        opacity_reg = model.opacity_reg_now
        update = self.optimizers.update()
        factors = update.factors()
        nonfinite_flag = self.pipeline.log.nonfinite_flag
        if model.dropout is not None:
            model.dropout.begin(model.step)
        if self.graphed is not None:
            result = self.graphed.replay(groups, opacity_reg, update, factors, nonfinite_flag)
            if result is not None:
                return result
        factors = factors.to(update.device, non_blocking=True)
        return training_step(model, groups, opacity_reg, update, factors, nonfinite_flag)

    def _own_requests(self) -> StepRequests:
        """Return what this process asks all processes to do after the step."""
        signals: tuple[int, ...] = ()
        if self._interrupts.received is not None:
            signals = (self._interrupts.received,)
        return StepRequests(save=self._save_is_due(), signals=signals)

    def _save_is_due(self) -> bool:
        """Tell whether a checkpoint is due by this process's clock."""
        return time.monotonic() >= self._save_due

    def _update_viewer_state(self, step: int) -> None:
        """Stop or save if that is due; nerfstudio calls this after every step, when densification is done."""
        self._completed_step = step
        self._stepping = False
        if self.world.is_single:
            self._interrupts.poll()
            save_is_due = self._save_is_due()
        else:
            requests = StepRequests.decode(self.world.flags_in)
            if requests.signals:
                raise Interrupted(requests.signals[0])
            save_is_due = requests.save
        self._stop_if_diverged()
        if save_is_due:
            self.save_checkpoint(step)
        super()._update_viewer_state(step)

    def _after_train(self) -> None:
        events.report("loop ends")
        super()._after_train()

    def eval_iteration(self, step: int) -> None:
        """Measure held-out views as nerfstudio does, if one device holds all Gaussians."""
        if self.world.is_single:
            super().eval_iteration(step)

    def _train_complete_viewer(self) -> None:
        """Wait for the viewer's user, as nerfstudio does, unless the run must stop."""
        self._interrupts.poll()
        self._stop_if_diverged()
        super()._train_complete_viewer()

    def _schedule_save(self, last_seconds: float) -> None:
        """Set when the next checkpoint is due, after the last one took so many seconds to save."""
        wait = math.inf
        if self.config.steps_per_save == 0 and self.config.seconds_per_save > 0:
            wait = max(self.config.seconds_per_save, last_seconds / _SAVING_SHARE)
        self._save_due = time.monotonic() + wait

    def _stop(self, interrupted: Interrupted, total: int) -> None:
        """Save a checkpoint, and name it in `config.yml`; return if the run was done, else raise SystemExit."""
        if self._completed_step > self._saved_step:
            self.save_checkpoint(self._completed_step)
        done = self._completed_step + 1
        if done >= total:
            return
        if done == self._start_step:
            text = f"{interrupted}: {_NOTHING_DONE}."
        else:
            file = self._write_config_to_resume(total)
            command = shlex.join(["ns-train", str(self.config.method_name), "--load-config", str(file)])
            text = f"{interrupted}: stopped and saved after {done} of {total} iterations; resume with: {command}"
        if interrupted.number == signal.SIGHUP:  # Some systems take the terminal away later.
            interrupts.discard_broken_output()
        note(text)
        self.world.all(True)  # As soon as one process has ended, the others are ended.
        raise SystemExit(128 + interrupted.number)

    def _write_config_to_resume(self, total: int) -> Path:
        """Write a `config.yml` with which --load-config resumes from the last checkpoint; return its path."""
        config = copy.copy(self.config)
        config.max_num_iterations = total
        config.load_dir = self.checkpoint_dir
        config.load_step = None
        config.load_checkpoint = None
        config.vis = self._requested_vis
        if processes.is_rank_zero():
            return run_folder.write_config(config)
        return self.base_dir / "config.yml"

    def _stop_if_diverged(self) -> None:
        """Save the Gaussians and raise RunError if the run has diverged."""
        if not self.pipeline.diverged:
            return
        parameters = self.pipeline.model.gauss_params.values()
        are_finite = all(bool(parameter.isfinite().all()) for parameter in parameters)
        if self.world.all(are_finite):
            if self._completed_step > self._saved_step:
                self.save_checkpoint(self._completed_step)
            kept = f"the Gaussians as they are now are saved and go on with --load-dir {self.checkpoint_dir}"
        else:
            kept = "the Gaussians themselves are not finite: train anew, or from a checkpoint in which they are"
        remedy = "look at them with sadgs-doctor, and lower the learning rates if you raised them"
        raise RunError(f"{self.pipeline.diverged}; {remedy}; {kept}.")

    def save_checkpoint(self, step: int) -> None:
        """Save a checkpoint by `checkpoints.write`. Rank 0 gathers and writes the Gaussians of all processes."""
        start = time.monotonic()
        state = {
            "step": step,
            "pipeline": self.pipeline.state_dict(),
            "optimizers": {name: adam.state_dict() for name, adam in self.optimizers.optimizers.items()},
            "schedulers": {name: rates.state_dict() for name, rates in self.optimizers.schedulers.items()},
            "scalers": self.grad_scaler.state_dict(),
        }
        if not self.world.is_single:
            state = checkpoints.map_rows(state, self.world.gather_rows)
        if processes.is_rank_zero():
            # If the run has diverged, an earlier checkpoint may be better.
            keep_others = not self.config.save_only_latest_checkpoint or bool(self.pipeline.diverged)
            checkpoints.write(self.checkpoint_dir, step, state, keep_others)
        self.world.all(True)  # All processes wait until rank 0 has written it.
        self._saved_step = step
        self._schedule_save(time.monotonic() - start)
