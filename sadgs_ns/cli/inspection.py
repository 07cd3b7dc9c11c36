"""The pictures of `sadgs-inspect`: what the method sees in a view of a run, and what one step would split."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
import yaml
from nerfstudio.engine.trainer import TrainerConfig
from rich.progress import track
from torch import Tensor

from sadgs_ns.errors import InputError, reason
from sadgs_ns.files import check_encoding
from sadgs_ns.method.growth import absgs, apply
from sadgs_ns.method.quantization import dequantize
from sadgs_ns.method.screen_gradients import accumulate_gradients, empty_gradients, keep_gradient
from sadgs_ns.method.split import grid_split, num_children
from sadgs_ns.render.blending import blend
from sadgs_ns.render.types import Cameras as Pinholes
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.config_file import ConfigLoader
from sadgs_ns.training.model import SadgsModel
from sadgs_ns.training.pipeline import SadgsPipeline
from sadgs_ns.training.run import checkpoints
from sadgs_ns.training.step.structure_cache import observe_training_views
from sadgs_ns.viewer import color_scales, maps
from sadgs_ns.viewer.color_scales import CHILDREN, ETA, LOW, PERIOD, Panel, Picture, Scale, to_picture

Split = Literal["train", "eval"]
SEED = 0  # Seed of the random colours and of AbsGS's children
MIN_SIDE = 900
"""Least longer side in px of a picture with ellipses; in a smaller one they could not be told apart."""
MIN_RENDER_SIDE = 640
"""Least longer side in px of a picture in random colours; in a smaller one Gaussians could not be told apart."""
_REMEDY = "give another with --load-step, or another run of sadgs"


@dataclass(frozen=True)
class View:
    """A photo of the data and its camera."""

    name: str
    photo: Tensor  # Colours in [0, 1]. [H, W, 3]
    structure_tensor: Tensor  # S̄ of the photo. [H, W, 3]
    camera: Pinholes  # A single camera


def load_run(path: Path, load_step: int | None = None, data: Path | None = None) -> tuple[SadgsPipeline, int]:
    """Load a finished or running run from its `config.yml`, as nerfstudio's `eval_setup` does.

    The arguments are the options of `sadgs_ns.cli.inspect.Inspect`. Checkpoints are looked for beside the file.

    Returns:
        The pipeline in evaluation mode, and the number of its iterations.

    Raises:
        InputError: If a file is missing, cannot be read or is of another method.
    """
    if path.is_dir():
        path = path / "config.yml"
    config = _read_config(path)
    folder = path.parent / config.relative_model_dir
    if not any(folder.glob("*")):
        raise InputError(f"{folder} holds no checkpoint yet: train to the end, or with --steps-per-save 500.")
    chosen = checkpoints.read_chosen(folder, load_step, None, _REMEDY)
    assert chosen is not None  # The folder holds a checkpoint, or reading it has raised InputError.
    checkpoint, state = chosen
    if data is not None:
        config.pipeline.datamanager.data = data
    capture = config.pipeline.datamanager.data
    if capture is not None and not capture.exists():
        raise InputError(f"{capture.absolute()} does not exist: give --data the folder of the run's capture.")
    device = torch.device("cpu")
    if torch.cuda.is_available():
        device = torch.device("cuda")
    pipeline: SadgsPipeline = config.pipeline.setup(device=device, test_mode="test")
    pipeline.eval()
    try:
        pipeline.load_pipeline(state["pipeline"], state["step"])
    except InputError as error:
        raise InputError(f"{checkpoint} does not fit its run: {str(error).rstrip('.')}; {_REMEDY}.") from error
    except (KeyError, RuntimeError) as error:  # A part is missing or has another size.
        raise InputError(f"{checkpoint} is not of this version of sadgs ({reason(error)}): {_REMEDY}.") from error
    return pipeline, state["step"] + 1


def _read_config(path: Path) -> SadgsTrainerConfig:
    """Read a run's config.yml, or raise InputError, also if it names other code than nerfstudio's and ours."""
    if not path.is_file():
        raise InputError(f"{path} does not exist: give the config.yml of a run, outputs/…/sadgs/…/config.yml.")
    try:
        config = yaml.load(path.read_text("utf8"), Loader=ConfigLoader)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        problem = " ".join(str(error).split())
        raise InputError(f"{path} cannot be read as a run's config.yml ({problem}): give one of sadgs.") from error
    remedy = "give one of a method whose name begins with sadgs."
    if not isinstance(config, TrainerConfig):
        raise InputError(f"{path} is no run's config.yml: {remedy}")
    if not isinstance(config, SadgsTrainerConfig):
        raise InputError(f"{path} is of the method {config.method_name}: {remedy}")
    return config


def get_view(pipeline: SadgsPipeline, index: int, split: Split = "train") -> View:
    """Return a view by its number in the split, from 0; raise InputError if there is none."""
    datamanager = pipeline.datamanager
    is_training = split == "train"
    dataset = datamanager.eval_dataset
    if is_training:
        dataset = datamanager.train_dataset
    if not 0 <= index < len(dataset):
        raise InputError(f"--view {index}: the {split} split has views 0 to {len(dataset) - 1}.")
    # The images come before the camera, because undistorting them changes the intrinsics.
    if is_training:
        data = datamanager.cached_train[index]
    else:
        data = datamanager.cached_eval[index]
    camera = pipeline.model.pinhole(dataset.cameras[index : index + 1])
    if is_training:  # Poses may be learned.
        viewmats = pipeline.views.viewmat(index)[None]
        camera = camera._replace(viewmats=viewmats)
    quantized = next(pipeline.structure_cache.quantized([data]))
    return View(
        name=dataset.image_filenames[index].name,
        photo=pipeline.structure_cache.photo(data),
        structure_tensor=dequantize(quantized),
        camera=camera,
    )


def screen_gradients(pipeline: SadgsPipeline, progress: Callable[[range], Iterable[int]] = iter) -> dict[str, Tensor]:
    """Add up the loss's screen gradients of all training views, by which AbsGS decides.

    Returns the sums of `method.screen_gradients.empty_gradients`. `progress` yields the numbers of the views.
    """
    model = pipeline.model
    gradients = empty_gradients(model.num_points, pipeline.device)
    num_views = len(pipeline.datamanager.train_dataset)
    for index in progress(range(num_views)):
        info = _backpropagate(pipeline, index)
        accumulate_gradients(gradients, info, num_views=1)
        model.zero_grad(set_to_none=True)
    return gradients


@torch.enable_grad()
def _backpropagate(pipeline: SadgsPipeline, index: int) -> dict[str, Any]:
    """Compute the gradients of a training view's loss, and return the rasterizer's info with those of means2d."""
    model = pipeline.model
    data = pipeline.datamanager.cached_train[index]
    height, width = data["image"].shape[:2]
    viewmats, Ks = pipeline.views.stacked_cameras([index])
    camera = Pinholes(viewmats.detach(), Ks, width, height)
    render, alpha, info = model.render(camera, model.color_options(absgrad=True))
    keep_gradient(info["means2d"])
    rgb = render[..., :3] + (1 - alpha) * model.background
    outputs = {"rgb": rgb, "background": model.background}
    batch = {}
    for name in ("image", "mask"):
        if name in data:
            batch[name] = data[name][None].to(pipeline.device)
    loss = model.get_loss_dict(outputs, batch)["main_loss"]
    loss.backward()
    return info


def _densify_copies(
    model: SadgsModel, state: dict[str, Any], densify: Callable[[Any, Any, Any], Any]
) -> dict[str, Tensor]:
    """Densify copies of the model's Gaussians by a function of parameters, optimizers and state.

    Returns the raw parameters of M Gaussians, and as `origins`, int64 [M], the Gaussian that each was or came from.
    """
    params = {name: torch.nn.Parameter(value.detach().clone()) for name, value in model.gauss_params.items()}
    # Children inherit parameters, while rows of the state begin anew. float64 counts exactly.
    numbers = torch.arange(model.num_points, device=model.device, dtype=torch.float64)
    params["origins"] = torch.nn.Parameter(numbers)
    optimizers = {name: torch.optim.SGD([parameter], lr=0.0) for name, parameter in params.items()}
    densify(params, optimizers, state)
    densified = {name: value.detach() for name, value in params.items()}
    densified["origins"] = densified["origins"].long()
    return densified


def structure_step(model: SadgsModel, statistics: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the Gaussians after a structure-aware step without its pruning, as `_densify_copies` does."""
    counts = model.strategy.planned_children(model.gauss_params, statistics)
    split = partial(grid_split, counts=counts, child_scale=model.strategy.options.child_scale)
    return _densify_copies(model, {}, split)


def conventional_step(model: SadgsModel, gradients: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the Gaussians after AbsGS's clones and splits in two, without pruning, as `_densify_copies` does."""
    options = replace(model.plan.strategy, absgs_long_axis=False)
    strategy = options.for_run(model.plan.iterations)
    state = {**gradients, "scene_scale": model.strategy_state["scene_scale"]}
    proposal, allowed = strategy.planned_growth(absgs, model.gauss_params, state)
    grow = partial(apply, proposal, allowed)
    devices = []
    if model.device.type == "cuda":
        devices.append(model.device)
    with torch.random.fork_rng(devices=devices):
        torch.manual_seed(SEED)  # gsplat draws the children's places at random.
        return _densify_copies(model, state, grow)


def view_panels(pipeline: SadgsPipeline, view: View, statistics: dict[str, Tensor]) -> dict[str, Panel]:
    """Return the pictures of one view by their names."""
    model = pipeline.model
    params = dict(model.gauss_params.items())
    drawing = model.drawing
    counts = model.strategy.planned_children(model.gauss_params, statistics)  # [N, 3]
    is_low = model.strategy.consistently_low(statistics)  # [N]
    splits = (counts > 1).any(dim=1)  # [N]
    num_split = int(splits.sum())
    more = num_children(counts) - 1  # [N]
    num_added = int(more.sum())
    num_low = int(is_low.sum())
    of_all = f"of {model.num_points:,} Gaussians"
    period = maps.texture_period(view.structure_tensor, pipeline.config.frequency_constant)
    eta = maps.eta_map(params, statistics, view.camera, drawing)
    children = maps.children_map(params, counts, view.camera, drawing)
    low = maps.mean_map(params, is_low.float(), view.camera, drawing)

    def panel(title: str, picture: Picture, scale: Scale) -> Panel:
        return Panel(f"{view.name}: {title}", picture, scale)

    ellipses_title = "the structure tensor, its inverse as ellipses"
    eta_title = "η of the Gaussians, largest of their observations; over 1 violates"
    children_title = f"{num_split:,} {of_all} would split, {num_added:,} more"
    low_title = f"{num_low:,} {of_all} are consistently low (η < 0.1)"
    return {
        "ellipses": panel(ellipses_title, _ellipses(pipeline, view), PERIOD),
        "wavelength": panel("local wavelength", PERIOD(period), PERIOD),
        "eta": panel(eta_title, ETA(eta), ETA),
        "children": panel(children_title, CHILDREN(children), CHILDREN),
        "low": panel(low_title, LOW(low), LOW),
    }


def _ellipses(pipeline: SadgsPipeline, view: View) -> Picture:
    """Draw S̄⁻¹ of a view as ellipses over its photo, which is enlarged if it is small."""
    height, width = view.photo.shape[:2]
    longer_side = max(height, width)
    enlarge = max(MIN_SIDE / longer_side, 1.0)
    size = (round(enlarge * height), round(enlarge * width))
    photo = to_picture(view.photo)
    return maps.draw_ellipses(photo, view.structure_tensor, pipeline.config.frequency_constant, size)


def step_panels(
    model: SadgsModel, view: View, conventional: dict[str, Tensor], structure: dict[str, Tensor]
) -> list[Panel]:
    """Return the photo, and the Gaussians in random colours before and after a step of each kind (paper, figure 3)."""
    generator = torch.Generator().manual_seed(SEED)
    colors = maps.random_colors(model.num_points, generator).to(model.device)
    colors_after_conventional = maps.recolor(colors, conventional["origins"], generator)
    colors_after_structure = maps.recolor(colors, structure["origins"], generator)
    viewmats, Ks, width, height = view.camera
    longer_side = max(height, width)
    enlarge = max(math.ceil(MIN_RENDER_SIDE / longer_side), 1)
    larger_Ks = Ks * Ks.new_tensor([[enlarge], [enlarge], [1.0]])  # The last row of an intrinsic matrix is no length.
    camera = Pinholes(viewmats, larger_Ks, enlarge * width, enlarge * height)

    def panel(title: str, params: Any, its_colors: Tensor) -> Panel:
        render, _ = blend(params, its_colors, camera, model.drawing)
        number = len(params["means"])
        return Panel(f"{title}: {number:,} Gaussians", to_picture(render))

    photo = to_picture(view.photo)
    photo = photo.repeat(enlarge, axis=0).repeat(enlarge, axis=1)
    return [
        Panel(f"photo {view.name}", photo),
        panel("before", model.gauss_params, colors),
        panel("one conventional step", conventional, colors_after_conventional),
        panel("one structure-aware step", structure, colors_after_structure),
    ]


def inspect_run(
    config: Path, view: int, split: Split, output: Path | None, load_step: int | None, data: Path | None
) -> list[Path]:
    """Write the pictures that `sadgs_ns.cli.inspect.Inspect` asks for, and return their files.

    Raise InputError as `load_run` and `get_view` before anything is written, and WriteError if a file cannot be.
    """
    check_encoding(config)
    pipeline, iterations = load_run(config, load_step, data)
    model = pipeline.model
    shown = get_view(pipeline, view, split)
    progress = partial(track, transient=True)
    observing = partial(progress, description="η in all training views")
    statistics = observe_training_views(pipeline.structure_cache, observing)
    backpropagating = partial(progress, description="gradients of all training views")
    gradients = screen_gradients(pipeline, backpropagating)
    num_views = len(pipeline.views)
    print(f"{config}: {model.num_points} Gaussians after {iterations} iterations on {num_views} training views.")

    pictures = {}
    for name, panel in view_panels(pipeline, shown, statistics).items():
        pictures[name] = [panel]
    conventional = conventional_step(model, gradients)
    structure = structure_step(model, statistics)
    pictures["step"] = step_panels(model, shown, conventional, structure)

    folder = output
    if folder is None:
        run_folder = config
        if not config.is_dir():
            run_folder = config.parent
        folder = run_folder / "inspect"
    files = []
    for name, panels in pictures.items():
        file = folder / f"{split}-{view:03d}-{name}.png"
        color_scales.draw(file, panels, columns=min(len(panels), 2))
        files.append(file)
    return files
