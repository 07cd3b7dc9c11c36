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
from sadgs_ns.method.growth import absgs, apply
from sadgs_ns.method.quantization import dequantize
from sadgs_ns.method.screen_gradients import accumulate_gradients, empty_gradients, keep_gradient
from sadgs_ns.method.split import grid_split, num_children
from sadgs_ns.render.blending import blend
from sadgs_ns.render.types import Cameras as Pinholes
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.model import SadgsModel
from sadgs_ns.training.pipeline import SadgsPipeline
from sadgs_ns.training.run import checkpoints
from sadgs_ns.training.step.structure_cache import observe_training_views
from sadgs_ns.viewer import color_scales, maps
from sadgs_ns.viewer.color_scales import CHILDREN, ETA, LOW, PERIOD, Panel, to_picture

Split = Literal["train", "eval"]
SEED = 0  # Seed of the random colours and of AbsGS's children
MIN_SIDE, MIN_RENDER_SIDE = 900, 640
"""Least longer side in px of a picture with ellipses and of one in random colours; smaller ones show no Gaussians."""
_REMEDY = "give another with --load-step, or another run of sadgs"


@dataclass(frozen=True)
class View:
    """A photo of the data and its camera."""

    name: str
    photo: Tensor  # Colours in [0, 1]. [H, W, 3]
    structure_tensor: Tensor  # S̄ of the photo. [H, W, 3]
    camera: Pinholes  # A single camera


def load_run(path: Path, load_step: int | None = None, data: Path | None = None) -> tuple[SadgsPipeline, int]:
    """Load a finished or running run from its `config.yml`, as nerfstudio's `eval_setup` does; options as `Inspect`'s.

    The file is read with PyYAML's full loader, which calls what it names. Checkpoints are looked for beside it. Return
    the pipeline in evaluation mode, and its iterations; raise InputError if a file is missing or of another method.
    """
    if path.is_dir():
        path = path / "config.yml"
    if not path.is_file():
        raise InputError(f"{path} does not exist: give the config.yml of a run, outputs/…/sadgs/…/config.yml.")
    try:
        config = yaml.load(path.read_text("utf8"), Loader=yaml.Loader)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        what = " ".join(str(error).split())
        raise InputError(f"{path} cannot be read as a run's config.yml ({what}): give one of sadgs.") from error
    if not isinstance(config, SadgsTrainerConfig):
        method = f"of the method {config.method_name}" if isinstance(config, TrainerConfig) else "no run's config.yml"
        raise InputError(f"{path} is {method}: give one of a method whose name begins with sadgs.")
    folder = path.parent / config.relative_model_dir
    if not any(folder.glob("*")):
        raise InputError(f"{folder} holds no checkpoint yet: train to the end, or with --steps-per-save 500.")
    chosen = checkpoints.read_chosen(folder, load_step, None, _REMEDY)
    assert chosen is not None
    checkpoint, state = chosen
    config.pipeline.datamanager.data = data or config.pipeline.datamanager.data
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    pipeline: SadgsPipeline = config.pipeline.setup(device=device, test_mode="test")
    pipeline.eval()
    try:
        pipeline.load_pipeline(state["pipeline"], state["step"])
    except InputError as error:
        raise InputError(f"{checkpoint} does not fit its run: {str(error).rstrip('.')}; {_REMEDY}.") from error
    except (KeyError, RuntimeError) as error:  # A part is missing or has another size.
        raise InputError(f"{checkpoint} is not of this version of sadgs ({reason(error)}): {_REMEDY}.") from error
    return pipeline, state["step"] + 1


def get_view(pipeline: SadgsPipeline, index: int, split: Split = "train") -> View:
    """Return a view by its number in the split, from 0; raise InputError if there is none."""
    training, datamanager = split == "train", pipeline.datamanager
    dataset = datamanager.train_dataset if training else datamanager.eval_dataset
    if not 0 <= index < len(dataset):
        raise InputError(f"--view {index}: the {split} split has views 0 to {len(dataset) - 1}.")
    # Undistorting the images changes the intrinsics.
    data = (datamanager.cached_train if training else datamanager.cached_eval)[index]
    camera = pipeline.model.pinhole(dataset.cameras[index : index + 1])
    if training:  # Poses may be learned.
        camera = camera._replace(viewmats=pipeline.views.viewmat(index)[None])
    structure_tensor = dequantize(next(pipeline.structure_cache.quantized([data])))
    return View(dataset.image_filenames[index].name, pipeline.structure_cache.photo(data), structure_tensor, camera)


def screen_gradients(pipeline: SadgsPipeline, progress: Callable[[range], Iterable[int]] = iter) -> dict[str, Tensor]:
    """Add up the loss's screen gradients of all training views, by which AbsGS decides, as `empty_gradients`."""
    model = pipeline.model
    gradients = empty_gradients(model.num_points, pipeline.device)
    for index in progress(range(len(pipeline.datamanager.train_dataset))):
        data = pipeline.datamanager.cached_train[index]
        height, width = data["image"].shape[:2]
        viewmats, Ks = pipeline.views.stacked_cameras([index])
        with torch.enable_grad():
            cameras = Pinholes(viewmats.detach(), Ks, width, height)
            render, alpha, info = model.render(cameras, model.color_options(absgrad=True))
            keep_gradient(info["means2d"])
            outputs = {"rgb": render[..., :3] + (1 - alpha) * model.background, "background": model.background}
            batch = {name: data[name][None].to(pipeline.device) for name in ("image", "mask") if name in data}
            model.get_loss_dict(outputs, batch)["main_loss"].backward()
        accumulate_gradients(gradients, info, num_views=1)
        model.zero_grad(set_to_none=True)
    return gradients


def _try(model: SadgsModel, state: dict[str, Any], densify: Callable[[Any, Any, Any], Any]) -> dict[str, Tensor]:
    """Densify copies of the model's Gaussians by a function of parameters, optimizers and state.

    Return the raw parameters of M Gaussians, and as `origins`, int64 [M], the Gaussian that each was or came from.
    """
    params = {name: torch.nn.Parameter(value.detach().clone()) for name, value in model.gauss_params.items()}
    # Children inherit parameters, while rows of the state begin anew. float64 counts exactly.
    numbers = torch.arange(model.num_points, device=params["means"].device, dtype=torch.float64)
    params["origins"] = torch.nn.Parameter(numbers)
    densify(params, {name: torch.optim.SGD([parameter], lr=0.0) for name, parameter in params.items()}, state)
    after = {name: value.detach() for name, value in params.items()}
    return after | {"origins": after["origins"].long()}


def structure_step(model: SadgsModel, statistics: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the Gaussians after a structure-aware step without its pruning, as `_try`."""
    counts = model.strategy.planned_children(model.gauss_params, statistics)
    return _try(model, {}, partial(grid_split, counts=counts, child_scale=model.strategy.options.child_scale))


def conventional_step(model: SadgsModel, gradients: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the Gaussians after a step of AbsGS, clones and splits in two, without its pruning, as `_try`."""
    options = replace(model.plan.strategy, absgs_long_axis=False)
    strategy = options.for_run(model.plan.iterations)
    state = {**gradients, "scene_scale": model.strategy_state["scene_scale"]}
    densify = partial(apply, *strategy.planned_growth(absgs, model.gauss_params, state))
    with torch.random.fork_rng(devices=[model.device] if model.device.type == "cuda" else []):
        torch.manual_seed(SEED)  # gsplat draws the children's places at random.
        return _try(model, state, densify)


def view_panels(pipeline: SadgsPipeline, view: View, statistics: dict[str, Tensor]) -> dict[str, Panel]:
    """Return the pictures of one view by their names."""
    model, constant = pipeline.model, pipeline.config.frequency_constant
    params, options = dict(model.gauss_params.items()), model.drawing
    counts = model.strategy.planned_children(model.gauss_params, statistics)
    is_low = model.strategy.consistently_low(statistics)
    enlarge = max(MIN_SIDE / max(view.photo.shape), 1.0)
    size = round(enlarge * view.photo.shape[0]), round(enlarge * view.photo.shape[1])
    split, added = int((counts > 1).any(dim=1).sum()), int((num_children(counts) - 1).sum())
    of_all = f"of {model.num_points:,} Gaussians"
    period = maps.texture_period(view.structure_tensor, constant)
    eta = maps.eta_map(params, statistics, view.camera, options)
    children = maps.children_map(params, counts, view.camera, options)
    low = maps.mean_map(params, is_low.float(), view.camera, options)
    panels = {
        name: Panel(f"{view.name}: {title}", scale(values), scale)
        for name, title, scale, values in (
            ("wavelength", "local wavelength", PERIOD, period),
            ("eta", "η of the Gaussians, largest of their observations; over 1 violates", ETA, eta),
            ("children", f"{split:,} {of_all} would split, {added:,} more", CHILDREN, children),
            ("low", f"{int(is_low.sum()):,} {of_all} are consistently low (η < 0.1)", LOW, low),
        )
    }
    ellipses = maps.draw_ellipses(to_picture(view.photo), view.structure_tensor, constant, size)
    return {"ellipses": Panel(f"{view.name}: the structure tensor, its inverse as ellipses", ellipses, PERIOD)} | panels


def step_panels(
    model: SadgsModel, view: View, conventional: dict[str, Tensor], structure: dict[str, Tensor]
) -> list[Panel]:
    """Return the photo, and the Gaussians in random colours before and after a step of each kind (paper, figure 3)."""
    generator = torch.Generator().manual_seed(SEED)
    colors = maps.random_colors(model.num_points, generator).to(model.device)
    viewmats, Ks, width, height = view.camera
    enlarge = max(math.ceil(MIN_RENDER_SIDE / max(height, width)), 1)
    camera = Pinholes(viewmats, Ks * Ks.new_tensor([[enlarge], [enlarge], [1.0]]), enlarge * width, enlarge * height)

    def panel(title: str, params: Any, its_colors: Tensor) -> Panel:
        render, _ = blend(params, its_colors, camera, model.drawing)
        return Panel(f"{title}: {len(params['means']):,} Gaussians", to_picture(render))

    return [
        Panel(f"photo {view.name}", to_picture(view.photo).repeat(enlarge, axis=0).repeat(enlarge, axis=1)),
        panel("before", model.gauss_params, colors),
        *(
            panel(title, step, maps.recolor(colors, step["origins"], generator))
            for title, step in (("one conventional step", conventional), ("one structure-aware step", structure))
        ),
    ]


def inspect_run(
    config: Path, view: int, split: Split, output: Path | None, load_step: int | None, data: Path | None
) -> list[Path]:
    """Write the pictures that `sadgs_ns.cli.inspect.Inspect` asks for, and return their files.

    Raise InputError as `load_run` and `get_view` before anything is written, and WriteError if a file cannot be.
    """
    pipeline, iterations = load_run(config, load_step, data)
    model, shown, views = pipeline.model, get_view(pipeline, view, split), len(pipeline.views)
    eta, gradient = (f"{what} all training views" for what in ("η in", "gradients of"))
    statistics = observe_training_views(pipeline.structure_cache, partial(track, transient=True, description=eta))
    gradients = screen_gradients(pipeline, partial(track, transient=True, description=gradient))
    print(f"{config}: {model.num_points} Gaussians after {iterations} iterations on {views} training views.")
    folder = output or (config if config.is_dir() else config.parent) / "inspect"
    pictures = {name: [panel] for name, panel in view_panels(pipeline, shown, statistics).items()}
    pictures["step"] = step_panels(model, shown, conventional_step(model, gradients), structure_step(model, statistics))
    written = {folder / f"{split}-{view:03d}-{name}.png": panels for name, panels in pictures.items()}
    for file, panels in written.items():
        color_scales.draw(file, panels, columns=min(len(panels), 2))
    return list(written)
