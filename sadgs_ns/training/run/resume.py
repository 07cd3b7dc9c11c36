"""The checkpoint that a run goes on from, and whether it fits the run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from nerfstudio.engine.trainer import TrainerConfig
from scipy.spatial import KDTree
from torch import Tensor

from sadgs_ns.data.cameras import camera_positions
from sadgs_ns.distributed.world import World
from sadgs_ns.errors import InputError, reason
from sadgs_ns.geometry.extents import camera_extent
from sadgs_ns.training.pipeline import SadgsPipeline
from sadgs_ns.training.run import checkpoints
from sadgs_ns.training.run.progress import note, warn
from sadgs_ns.training.run.run_plan import RunPlan
from sadgs_ns.training.step.optimizers import SadgsOptimizers


@dataclass
class Resumption:
    """A checkpoint to go on from, loaded in two parts. Errors are InputError and name the file and a remedy."""

    path: Path
    state: dict[str, Any]  # As nerfstudio's trainer writes it

    @classmethod
    def chosen_by(cls, config: TrainerConfig) -> Resumption | None:
        """Read the checkpoint that nerfstudio's options for resuming name, or return None if they name none.

        Raises InputError as `checkpoints.read_chosen`.
        """
        chosen = checkpoints.read_chosen(config.load_dir, config.load_step, config.load_checkpoint)
        if chosen is None:
            return None
        path, state = chosen
        return cls(path, state)

    @contextmanager
    def _errors_name_file(self) -> Iterator[None]:
        """Raise InputError with the file's name instead of any error inside, except that of full memory."""
        try:
            yield
        except torch.cuda.OutOfMemoryError:
            raise
        except InputError as error:
            problem = str(error).rstrip(".")
            raise InputError(f"{self.path} cannot be continued: {problem}; {checkpoints.REMEDY}.") from error
        except Exception as error:  # A file of another program may raise anything.
            problem = f"{type(error).__name__}: {reason(error)}"
            raise InputError(
                f"{self.path} is not a checkpoint of this version of sadgs ({problem}): {checkpoints.REMEDY}."
            ) from error

    @property
    def plan(self) -> RunPlan | None:
        """The plan of the run that wrote the checkpoint.

        None if the checkpoint is of another method, which `load_gaussians` refuses.
        """
        with self._errors_name_file():
            state = self.state["pipeline"].get("_extra_state")
            if state is None:
                return None
            return RunPlan.of(state["plan"])

    def load_gaussians(self, pipeline: SadgsPipeline, world: World) -> None:
        """Load the pipeline with this process's part of the Gaussians; call before optimizers are made.

        Raises InputError if the checkpoint is damaged, of another capture, or has parameters that the run lacks.
        """
        with self._errors_name_file():
            if not world.is_single:
                num_gaussians = len(self.state["pipeline"]["_model.gauss_params.means"])
                part = world.take_even_part(num_gaussians)
                self.state = checkpoints.map_rows(self.state, lambda rows: rows[part].clone())
            pipeline.load_pipeline(self.state["pipeline"], self.state["step"])
            extra = self.state["pipeline"]["_extra_state"]
            check_same_capture(pipeline, extra["images"], extra["camera_positions"])
            if pipeline.model.poses is not None:
                # Earlier versions kept Adam's moments of the poses in other units, so these start anew.
                self.state["optimizers"].pop("camera_opt", None)
                self.state.get("schedulers", {}).pop("camera_opt", None)
            missing = sorted(self.state["optimizers"].keys() - pipeline.get_param_groups().keys())
            if missing:
                raise InputError(
                    f"It optimized {' and '.join(missing)}, too: set pipeline.model.color-model and "
                    "pipeline.model.poses as they were, and train on one device."
                )

    def load_optimizers(self, optimizers: SadgsOptimizers, schedulers: bool) -> None:
        """Load the optimizers' moments, and print where the run goes on.

        The rates are those of this run's plan, of its first iteration unless the `schedulers` are to go on.
        """
        with self._errors_name_file():
            optimizers.load_optimizers(self.state["optimizers"])
            if schedulers:
                optimizers.go_on_after(self.state["step"] + 1, self.state.get("schedulers", {}))
        note(f"Resuming after step {self.state['step']} of {self.path}")


def check_same_capture(pipeline: SadgsPipeline, names_before: Sequence[str], positions_before: Tensor) -> None:
    """Check that a checkpoint was trained on the pipeline's data, by its images' names and cameras' centres [C, 3].

    Images may have been added or removed if the others' poses stayed. Warns if no image has its old name.

    Raises InputError if less than half of the cameras of the smaller capture are in the other.
    """
    dataset = pipeline.datamanager.train_dataset
    names = [path.name for path in dataset.image_filenames]
    positions = camera_positions(dataset.cameras)
    distances, _ = KDTree(positions).query(positions_before)  # [C]
    num_same = int((distances < checkpoints.SAME_PLACE * camera_extent(positions)).sum())
    if 2 * num_same < min(len(names_before), len(names)):
        raise InputError(
            "It was trained on other data, or with other options of the parser: of its "
            f"{len(names_before)} cameras ({names_before[0]}, …) {num_same or 'none'} stand where one of these "
            f"{len(names)} ({names[0]}, …) does."
        )
    stems_before = {Path(name).stem for name in names_before}
    stems = {Path(name).stem for name in names}
    if stems_before.isdisjoint(stems):
        warn(
            "The checkpoint's run had the same cameras, but none of its images had the name of one of "
            f"these ({names_before[0]} and {names[0]} are the first): the Gaussians fit only if the images "
            "were renamed."
        )
