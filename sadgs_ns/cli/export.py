"""`sadgs-export RUN --output FILE`: a run's Gaussians, or a mesh, in the format that the file's name asks for."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro
from numpy.typing import NDArray

from sadgs_ns import formats
from sadgs_ns.cli.program import parse
from sadgs_ns.data.coordinates import TRANSFORMS_NAME, Similarity, from_data
from sadgs_ns.errors import InputError, RunError, WriteError, sentence_on_full_gpu
from sadgs_ns.files import check_encoding
from sadgs_ns.formats import FORMATS, MESH, format_of, html
from sadgs_ns.formats.gaussians import DEFAULTS, DEGREE_0, Context, Start, of_parameters
from sadgs_ns.formats.mesh import load_open3d

if TYPE_CHECKING:  # torch takes seconds, which `--help` and a wrong path need not wait for
    from torch import Tensor

    from sadgs_ns.data.run_cameras import RunCameras
    from sadgs_ns.geometry.cleaning import Cleaning
    from sadgs_ns.render.types import RenderOptions

Box = tuple[float, float, float, float, float, float]  # Lowest x, y and z, and highest
_OUTPUT = f"The file to write: {', '.join(FORMATS)}, or {MESH} for a mesh."
_MAX_OFF_AXIS = 4.0  # Limit for runs of splatfacto, which has none; what it leaves out has no true size on the screen
_PREFIX = "_model.gauss_params."
_REMEDY = "give another checkpoint step-*.ckpt of a run of sadgs or splatfacto"


@dataclass
class Export:
    """Write a trained run's Gaussians as a file for viewers of 3D Gaussian splatting.

    The end of the file's name chooses the format: .ply, the largest, which all viewers read; .compressed.ply, .spz and
    .sog, which are smaller and lose a little; .glb, which is glTF with KHR_gaussian_splatting; .html, a page that opens
    in a browser without a network, for which Node.js must be installed. A name that ends in .mesh.ply is for a mesh
    fused from rendered depth, for measuring and previews; splats have no surface. No GPU is needed, and no code of the
    run's files is executed. Lengths are in units of nerfstudio's frame.
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Folder of a run, its config.yml, or one of its checkpoints."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE", help=_OUTPUT)]
    frame: Literal["nerfstudio", "colmap"] = "nerfstudio"
    """Coordinates: nerfstudio's, upright with cameras within ±1, or those of the COLMAP model or transforms.json."""
    data: Annotated[Path | None, tyro.conf.arg(metavar="DATA")] = None
    """Folder of the capture, for .html, .mesh.ply, --cameras, --min-views and --dust.
    By default it is where it was in training."""
    title: Annotated[str | None, tyro.conf.arg(metavar="TEXT")] = None
    """Title of a page; by default the name of the capture's folder."""
    cameras: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Also write the training cameras to this .json, as transforms.json, with the poses that the run has refined."""
    min_views: Annotated[int, tyro.conf.arg(metavar="K")] = 0
    """Take away Gaussians that fewer than K training views see."""
    max_extent: Annotated[float | None, tyro.conf.arg(metavar="UNITS")] = None
    """Take away Gaussians whose longest standard deviation is more than this."""
    crop: Annotated[Box | None, tyro.conf.arg(metavar="X Y Z X Y Z")] = None
    """Take away Gaussians whose centre is outside the box from the lowest x, y and z to the highest."""
    dust: Annotated[float, tyro.conf.arg(metavar="PX")] = 0.0
    """Take away Gaussians that fill fewer pixels of each training view: opacity times area, less what others hide."""
    voxel_size: Annotated[float | None, tyro.conf.arg(metavar="UNITS")] = None
    """Edge of a mesh's voxels; by default two pixels at the median depth, or more if memory is short."""


def write_gaussians(
    path: Path, params: Mapping[str, Tensor], context: Context = DEFAULTS, similarity: Similarity | None = None
) -> int:
    """Write a model's parameters as `formats.write` does, and return the number of Gaussians.

    Those with a value that is not finite are dropped, and a printed line says how many. The similarity maps the
    parameters' frame to the file's. Raises as `of_parameters` and `formats.write`.
    """
    gaussians = of_parameters(_arrays(params))
    moved = gaussians
    if similarity is not None:
        moved = gaussians.moved(similarity)
    sound = moved.finite()
    formats.write(path, sound, context)
    if len(sound) < len(gaussians):
        print(f"{path}: dropped {len(gaussians) - len(sound)} of {len(gaussians)} Gaussians that are not finite")
    return len(sound)


def _arrays(params: Mapping[str, Tensor]) -> dict[str, NDArray[np.floating]]:
    return {name: tensor.detach().cpu().numpy() for name, tensor in params.items()}


def export(options: Export) -> int:
    """Write the Gaussians of a run of sadgs or splatfacto, or a mesh; return the number of Gaussians or triangles.

    A printed line says what each option took away. Nothing in the run's folder is executed, not even `config.yml`.
    Raise InputError if the run, the capture, an option or the output cannot be used, WriteError if writing fails.
    """
    is_page = format_of(options.output) == ".html"
    is_mesh = format_of(options.output) == MESH
    _check(options)
    if is_mesh:
        load_open3d()  # It may be missing, which the user shall know before views are rendered.
    folders = _checkpoint_of(options.run).absolute().parents[:2]
    folder = next((folder for folder in folders if (folder / TRANSFORMS_NAME).is_file()), folders[-1])
    # These import torch.
    from sadgs_ns.geometry.cleaning import Cleaning
    from sadgs_ns.viewer.cleaning_text import check_options

    cleaning = Cleaning(options.min_views, options.max_extent, options.crop, options.dust)
    check_options(cleaning)
    similarity = None
    if options.frame == "colmap":
        similarity = from_data(folder / TRANSFORMS_NAME).inverse()
    params, drawing = read_checkpoint(options.run)
    if similarity is not None:
        _check_steps(similarity, float(params["scales"].median()))
    cameras = None
    if is_page or is_mesh or cleaning.needs_views or options.cameras is not None:
        from sadgs_ns.data.run_cameras import read_cameras

        cameras = read_cameras(folder, options.data)
    pipeline: dict[str, Any] = {}
    if cameras is not None and options.cameras is not None:
        from sadgs_ns.cli.exported_cameras import check_images

        _, pipeline = _load(options.run)
        check_images(pipeline, cameras)
    params = _cleaned(params, cleaning, cameras, drawing)
    if cameras is not None and options.cameras is not None:
        from sadgs_ns.cli.exported_cameras import write_cameras

        write_cameras(options.cameras, pipeline, cameras, similarity)
    if is_mesh and cameras is not None:
        from sadgs_ns.cli.meshing import write_mesh

        return write_mesh(options.output, params, cameras, similarity, options.voxel_size, drawing)
    context = Context(_axis_up(similarity))
    if is_page and cameras is not None:
        title = options.title
        if title is None:
            title = _capture_name(folder, options.data)
        context = replace(context, start=_start(cameras, params), title=title)
    return write_gaussians(options.output, params, context, similarity)


def _start(cameras: RunCameras, params: Mapping[str, Tensor]) -> Start:
    """Return the start of a page, in the view of the photo that was taken nearest to the middle of all places."""
    poses = cameras.camera_to_worlds.double().numpy()
    index = html.middle_camera(poses[:, :, 3])
    focal = float(cameras.Ks[index, 0, 0])
    return html.start_at(poses[index], max(cameras.sizes[index]), focal, params["means"].numpy())


def _capture_name(run: Path, data: Path | None) -> str:
    """Return the name of a capture's folder, or of its file's; `data` is given, or else the run tells it."""
    if data is None:
        from sadgs_ns.data.run_cameras import find_capture

        data, _ = find_capture(run)
    path = data.absolute()
    if path.suffix == ".json":
        path = path.parent
    return path.name


def _axis_up(similarity: Similarity | None) -> tuple[float, float, float]:
    """Return the axis of the file's frame that is nearest to up, given the map from nerfstudio's frame to it."""
    up = np.array([0.0, 0.0, 1.0])
    if similarity is not None:
        up = similarity.orthogonal[:, 2]
    nearest = np.eye(3)[np.abs(up).argmax()]
    x, y, z = (nearest * np.sign(up)).tolist()
    return x, y, z


def _check(options: Export) -> None:
    suffix = format_of(options.output)
    voxel_size = options.voxel_size
    if suffix == ".html" and options.frame != "nerfstudio":
        raise InputError("--frame colmap is for files that other programs read: leave it out for a page.")
    if suffix != ".html" and options.title is not None:
        raise InputError("--title is for pages: let --output end in .html, or leave it out.")
    if options.cameras is not None and options.cameras.suffix != ".json":
        raise InputError(f"--cameras {options.cameras} is for a file that ends in .json: name one.")
    if voxel_size is not None and suffix != MESH:
        raise InputError(f"--voxel-size is for meshes: let --output end in {MESH}, or leave it out.")
    if voxel_size is not None and not 0 < voxel_size < math.inf:
        raise InputError(f"--voxel-size {voxel_size:g} must be more than 0: leave it out to have it derived.")


def _check_steps(similarity: Similarity, log_size: float) -> None:
    """Raise InputError if float32, in which files hold positions, has larger steps in a frame than Gaussians' size."""
    place = float(np.abs(similarity.translation).max())
    step = float(np.spacing(np.float32(place)))
    if step > similarity.scale * math.exp(log_size):
        distance = f"{place:.3g} units from the origin"
        problem = f"--frame colmap puts the splat {distance}, where float32 has steps of {step:.2g}"
        remedy = f"leave it out, and place the file by the transform in the run's {TRANSFORMS_NAME}"
        raise InputError(f"{problem}: {remedy}.")


def _cleaned(
    params: dict[str, Tensor], cleaning: Cleaning, cameras: RunCameras | None, drawing: RenderOptions
) -> dict[str, Tensor]:
    """Return the parameters of the Gaussians that stay, and print how many each option takes away."""
    import torch
    from rich.console import Console
    from rich.progress import track

    from sadgs_ns.geometry.cleaning import Cleaning, choose_remaining, measure_visibility
    from sadgs_ns.render.rasterization import viewmats_from_camera_to_world
    from sadgs_ns.viewer.cleaning_text import removal_sentences

    if cleaning == Cleaning():
        return params
    device = torch.device("cpu")
    if torch.cuda.is_available():
        device = torch.device("cuda")
    seen = None
    shapes = {name: params[name].to(device) for name in ("means", "quats", "scales", "opacities")}
    if cleaning.needs_views and cameras is not None:
        viewmats = viewmats_from_camera_to_world(cameras.camera_to_worlds).to(device)
        Ks = cameras.Ks.to(device)
        views = [(viewmat, K, *size) for viewmat, K, size in zip(viewmats, Ks, cameras.sizes, strict=True)]
        console = Console(stderr=True)
        shown = track(views, "Looking from the training views", console=console, disable=not console.is_terminal)
        seen = measure_visibility(shapes, shown, drawing)
    remaining = choose_remaining(shapes, cleaning, seen)
    stays = remaining.stays
    print("\n".join(removal_sentences(cleaning, remaining)))
    if not stays.any():
        problem = f"These options take away all {len(stays):,} Gaussians"
        raise InputError(f"{problem}: nothing is written, so take fewer away.")
    return {name: value[stays.cpu()] for name, value in params.items()}


def _checkpoint_of(run: Path) -> Path:
    """Return the latest checkpoint of a run, which its folder, its `config.yml` or a checkpoint itself names."""
    if run.suffix == ".ckpt" and run.is_file():
        return run
    folder = run
    if run.is_file():
        folder = run.parent
    files = [*folder.glob("step-*.ckpt"), *folder.glob("*/step-*.ckpt")]
    steps = {path: path.stem.removeprefix("step-") for path in files}
    found = {path: int(step) for path, step in steps.items() if step.isdecimal()}
    if not found:
        problem = "holds no checkpoint"
        if not run.exists():
            problem = "does not exist"
        raise InputError(f"{run} {problem}: give the folder of a run, its config.yml or a checkpoint step-*.ckpt.")
    return max(found, key=lambda path: found[path])


def read_checkpoint(run: Path) -> tuple[dict[str, Tensor], RenderOptions]:
    """Read a run's parameters, as `of_parameters` takes them, and the options with which it drew them.

    The tensors are mapped from the file, and take no memory until they are read. Raise InputError if there is no
    checkpoint of this method or of splatfacto, or its Gaussians cannot be exported.
    """
    # These import torch, which takes seconds, and `--help` and a wrong path need not wait for it.
    from torch import Tensor

    from sadgs_ns.render.types import RenderOptions

    checkpoint, loaded = _load(run)
    params = {}
    for name in ("means", "scales", "quats", "opacities", "features_dc", "features_rest"):
        value = loaded.get(_PREFIX + name)
        if not isinstance(value, Tensor) or value.dim() < 2:
            raise InputError(f"{checkpoint} holds no {name} of Gaussians, so another method made it: {_REMEDY}.")
        params[name] = value
    if params["features_rest"].shape[1] == 0:  # then training holds colours' logits
        params["features_dc"] = (params["features_dc"].sigmoid() - 0.5) / DEGREE_0
    try:
        of_parameters(_arrays(params))
    except ValueError as error:
        raise InputError(f"{checkpoint} holds no Gaussians that can be exported ({error}): {_REMEDY}.") from error
    plan = {}
    state = loaded.get("_extra_state")
    if isinstance(state, dict):
        plan = state.get("plan", {})
    near_plane = plan.get("near_plane", RenderOptions.near_plane)
    max_off_axis = plan.get("max_off_axis", _MAX_OFF_AXIS)
    return params, RenderOptions(near_plane=near_plane, max_off_axis=max_off_axis)


def _load(run: Path) -> tuple[Path, dict[str, Any]]:
    """Return a run's checkpoint and the state of its pipeline, whose tensors are mapped from the file."""
    from sadgs_ns.training.run import checkpoints

    checkpoint = _checkpoint_of(run)
    if checkpoint == run:
        chosen = checkpoints.read_chosen(None, None, checkpoint, _REMEDY, mmap=True)
    else:
        chosen = checkpoints.read_chosen(checkpoint.parent, None, None, _REMEDY, mmap=True)
    assert chosen is not None
    checkpoint, content = chosen
    loaded = content["pipeline"]
    if not isinstance(loaded, dict):
        loaded = {}
    return checkpoint, loaded


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code, 2 if the run, the output or the GPU cannot be used."""
    options = parse(Export, "sadgs-export", argv)
    try:
        check_encoding(options.run)
        check_encoding(options.output)
        count = export(options)
    except (InputError, RunError, WriteError) as error:
        print(f"sadgs-export: {error}", file=sys.stderr)
        return 2
    except RuntimeError as error:
        import torch

        if not isinstance(error, torch.cuda.OutOfMemoryError):
            raise
        print(sentence_on_full_gpu("sadgs-export", options.run), file=sys.stderr)
        return 2
    parts = "Gaussians"
    if format_of(options.output) == MESH:
        parts = "triangles fused from rendered depth"
    megabytes = options.output.stat().st_size / 1e6
    print(f"{options.output}: {count:,} {parts}, {megabytes:,.1f} MB, in the frame of {options.frame}")
    return 0
