"""What a run does between the loading of its data and the first step."""

from __future__ import annotations

from dataclasses import dataclass

from sadgs_ns.distributed.world import World
from sadgs_ns.method.schedule import Schedule
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.pipeline import SadgsPipeline
from sadgs_ns.training.run import processes
from sadgs_ns.training.run.exposure_start import resume_with_gains, start_with_gains
from sadgs_ns.training.run.planning import (
    decide_near_plane,
    near_plane_of_scene,
    one_device_is_quicker,
    plan_length,
    plan_run,
)
from sadgs_ns.training.run.processes import Peers
from sadgs_ns.training.run.progress import note
from sadgs_ns.training.run.resume import Resumption
from sadgs_ns.training.run.run_plan import RunPlan
from sadgs_ns.training.run.stereo_start import start_from_stereo


@dataclass(frozen=True)
class PreparedRun:
    """What was decided before the first step; the pipeline has the Gaussians of this process and follows the plan."""

    plan: RunPlan
    world: World  # The processes that train, which may be fewer than were started
    peers: Peers | None  # Their hosts and ids; None if there is one process
    resumed: Resumption | None  # The checkpoint that the run goes on from; its optimizers are not loaded yet
    start_step: int  # The first step to train, from 0


def prepare_run(config: SadgsTrainerConfig, pipeline: SadgsPipeline, world: World, peers: Peers | None) -> PreparedRun:
    """Bring the pipeline to where a run begins or goes on, and plan the run; call before optimizers are made.

    `config` is the trainer's own: its `vis` is changed if several processes train, because these have no viewer.
    If one process would train more quickly than all, the others exit here. Raises InputError if the options, the
    checkpoint, the data and the machine do not fit each other.
    """
    pipeline.views.seed(config.machine.seed)
    resumed = Resumption.chosen_by(config)
    before = None
    if resumed is not None:
        before = resumed.plan
    of_scene = None
    if before is None:  # It looks at every point in every view.
        of_scene = near_plane_of_scene(pipeline)
    near_plane = decide_near_plane(pipeline.model.config, of_scene, before)
    if resumed is None:
        start_with_gains(pipeline, world)
    is_dense = start_from_stereo(pipeline, resumed=resumed is not None)
    if resumed is None:
        assert of_scene is not None
        pipeline.clear_paths(of_scene)
    length = plan_length(config, len(pipeline.views), before)
    world, peers = choose_processes(config, pipeline, length, world, peers)
    if not world.is_single:
        turn_viewer_off(config)
        if pipeline.model.poses is not None:
            note("The poses stay as they are: they are refined on one device only.")
        pipeline.model.shard(world)
    start_step = 0
    if resumed is not None:
        resumed.load_gaussians(pipeline, world)
        start_step = resumed.state["step"] + 1
        resume_with_gains(pipeline, world)
    pipeline.check_visibility(near_plane)
    plan = plan_run(config, pipeline, length, near_plane=near_plane, dense=is_dense, before=before, done=start_step)
    pipeline.follow(plan)
    return PreparedRun(plan, world, peers, resumed, start_step)


def choose_processes(
    config: SadgsTrainerConfig, pipeline: SadgsPipeline, length: Schedule, world: World, peers: Peers | None
) -> tuple[World, Peers | None]:
    """Return the processes that train: all, or only rank 0 if that is quicker, and then the others exit here."""
    if peers is None or config.share_always or not peers.on_one_machine():
        return world, peers
    cameras = pipeline.datamanager.train_dataset.cameras
    if not one_device_is_quicker(cameras, length.views_per_iteration, world.num_ranks):
        return world, peers
    processes.continue_on_rank_zero(world, peers)
    return World(), None


def turn_viewer_off(config: SadgsTrainerConfig) -> None:
    """Take the viewer out of the option `vis`, and print that if it was there."""
    if not config.is_viewer_enabled() and not config.is_viewer_legacy_enabled():
        return
    note("The viewer is off, since no device holds all Gaussians; `ns-viewer` shows the finished run.")
    others = config.vis.removeprefix("viewer_legacy").removeprefix("viewer").removeprefix("+")
    config.vis = others or "none"  # type: ignore[assignment]
