"""Errors whose message is one sentence, which names the problem and the remedy."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
import traceback as tracebacks
from pathlib import Path
from types import TracebackType

_NERFSTUDIOS: dict[tuple[str, type[Exception], str], str] = {
    ("utils.eval_utils.eval_setup", OSError, ""):
        "{error.filename} cannot be read ({reason}): give --load-config the config.yml of a run; paths in that file "
        "may be relative to the folder in which the run was started.",
    ("utils.eval_utils.eval_setup", AssertionError, ""):
        "The file that --load-config names is no config.yml of a run: give it one.",
    ("utils.eval_utils.eval_load_checkpoint", Exception, ""):
        "The latest checkpoint in the run's folder nerfstudio_models cannot be read ({reason}): remove it, and the one "
        "before it is taken if there is one, or train on with --load-dir and the run's folder.",
    ("cameras.camera_utils.get_interpolated_poses_many", ValueError, "at least one array"):
        "A path between views needs two of them, and the run holds out fewer: add --pose-source train, which takes the "
        "training views.",
    ("scripts.render.main", ValueError, "empty sequence"):
        "The run holds out no view that could be rendered: add --split train, which takes the training views.",
    ("scripts.render.main", AssertionError, ""):
        "`ns-render spiral` does not work with methods that train on whole images, as this one and splatfacto do: use "
        "`ns-render interpolate`, or `ns-render camera-path` with a path that was drawn in the viewer.",
    ("scripts.render._render_trajectory_video", AttributeError, "RayBundle"):
        "--render-nearest-camera does not work with methods that train on whole images, as this one and splatfacto do: "
        "leave it out, and copy the photo beside the picture.",
    ("scripts.render._render_trajectory_video", ZeroDivisionError, ""):
        "The camera path lasts 0 seconds: give it a longer duration in the viewer, or `seconds` in its file.",
    **dict.fromkeys(
        [
            ("scripts.render.main", OSError, "RGBA"),
            ("scripts.render._render_trajectory_video", OSError, "RGBA"),
            ("scripts.render._render_trajectory_video", ValueError, "concatenation axis"),
            ("scripts.render._render_trajectory_video", ValueError, "are invalid"),
        ],
        "`rgba` fits into PNG alone, and beside no other output: give --rendered-output-names rgba --image-format png, "
        "and for a path --output-format images.",
    ),
    **dict.fromkeys(
        [("scripts.render.main", FileNotFoundError, ""), ("scripts.render.main", IsADirectoryError, "")],
        "{error.filename} cannot be read ({reason}): give --camera-path-filename the file of a path that was drawn in "
        "the viewer.",
    ),
    **dict.fromkeys(
        [
            ("scripts.render.main", UnicodeDecodeError, ""),
            ("scripts.render.main", json.JSONDecodeError, ""),
            ("scripts.render.main", TypeError, "indices must be integers"),
        ],
        "The file that --camera-path-filename names is no camera path ({reason}): give a file that the viewer or the "
        "add-on for Blender wrote.",
    ),
    **dict.fromkeys(
        [
            ("scripts.render.main", KeyError, "seconds"),
            ("scripts.render.get_crop_from_json", KeyError, ""),
            ("cameras.camera_paths.get_path_from_json", KeyError, ""),
        ],
        "The file that --camera-path-filename names is no camera path, because it lacks {reason}: give a file that the "
        "viewer or the add-on for Blender wrote.",
    ),
    ("cameras.camera_paths.get_path_from_json", RuntimeError, "non-empty"):
        "The file that --camera-path-filename names has no cameras: add keyframes to the path in the viewer, and save "
        "it again.",
    **dict.fromkeys(
        [
            ("cameras.camera_paths.get_path_from_json", Exception, ""),
            ("scripts.render.get_crop_from_json", Exception, ""),
        ],
        "The file that --camera-path-filename names has a value that cannot be read ({reason}): save the path in the "
        "viewer again.",
    ),
    ("scripts.eval.main", AssertionError, ""):
        "--output-path must end with .json: give the file of results another name.",
    **dict.fromkeys(
        [
            ("models.base_model.forward", AttributeError, "RayBundle"),
            ("models.base_model.get_outputs_for_camera_ray_bundle", Exception, "eval_num_rays_per_chunk"),
            ("scripts.exporter.main", Exception, "train_pixel_sampler"),
            ("scripts.exporter.main", Exception, "SDF field"),
        ],
        "`ns-export pointcloud`, `poisson`, `tsdf` and `marching-cubes` are for fields of density, and a splat has "
        "none: `sadgs-export RUN --output room.mesh.ply` writes a mesh, and to a .ply the Gaussians.",
    ),
    **dict.fromkeys(
        [("scripts.train.launch", Exception, f"terminated with {how}") for how in ("signal", "exit code")],
        "A process of the run ended, and the others with it ({reason}): what the last checkpoint holds goes on "
        "with --load-dir and the run's folder.",
    ),
    ("utils.writer.__init__", Exception, ""):
        "The logger that --vis names could not start ({reason}): log in to its service, or choose another --vis.",
}  # fmt: skip
"""Errors of nerfstudio's commands, around which none of our code runs: nerfstudio's innermost function in the
traceback, the kind of error and a part of its text; and the sentence to print instead."""


class InputError(ValueError):
    """Data, options or a checkpoint cannot be used; the message names the input and the remedy."""


class RunError(RuntimeError):
    """A run cannot go on; the message says why, what was saved and what helps."""


class WriteError(OSError):
    """A file could not be written; the message names it, the error, the free space and the remedy."""

    def __init__(self, path: Path, error: Exception) -> None:
        super().__init__(
            f"{path} could not be written ({reason(error)}; {free_space(path)} free there): make room or name a folder "
            "that can be written; nothing half-written is left, and a file that was there is as it was."
        )


def sentence_on_full_gpu(command: str, path: Path) -> str:
    """Return the sentence of one of our commands on a run or file for which the GPU's memory is too small."""
    remedy = f"end other programs on it, or work on the CPU: CUDA_VISIBLE_DEVICES= {command} …"
    return f"{command}: the GPU's memory does not hold {path}: {remedy}"


def check_working_directory() -> None:
    """Raise InputError if the working directory was deleted; there importing torch ends the process without a word."""
    try:
        os.getcwd()
    except FileNotFoundError:
        print_uncaught_errors_as_sentences()
        raise InputError("The working directory was deleted: change to a folder that exists with `cd`.") from None


def print_uncaught_errors_as_sentences() -> None:
    """Have Python print our errors, and some of nerfstudio's, that nobody catches as a sentence without a traceback.

    nerfstudio's commands run none of our code around their work, but all import the package's `training` folder, which
    calls this. The exit code stays 1, and other errors are shown as before.
    """
    show = sys.excepthook

    def show_sentence(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
        sentence = sentence_of(error)
        if sentence is None:
            show(kind, error, traceback)
        else:
            print(f"error: {sentence}", file=sys.stderr)

    sys.excepthook = show_sentence


def sentence_of(error: BaseException) -> str | None:
    """Return the sentence for an error of ours or of nerfstudio's; None if a traceback says more."""
    if isinstance(error, InputError | RunError | WriteError):
        return str(error)
    frames = [frame for frame, _ in tracebacks.walk_tb(error.__traceback__)]
    places = [f"{frame.f_globals.get('__name__')}.{frame.f_code.co_name}" for frame in frames]
    raised = re.findall(r"^sadgs_ns\.errors\.\w+: (.*)", str(error), re.MULTILINE)
    if raised and type(error).__name__ == "ProcessRaisedException":  # One of several processes told it to the first.
        return raised[-1]
    last = next((place for place in reversed(places) if place.startswith("nerfstudio.")), None)
    for (place, kind, part), sentence in _NERFSTUDIOS.items():
        if f"nerfstudio.{place}" == last and isinstance(error, kind) and part in str(error):
            return sentence.format(error=error, reason=reason(error))
    return None


def reason(error: BaseException) -> str:
    """Return the first line of a library's error without the full stop."""
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    lines = text.strip().splitlines()
    return lines[0].strip().rstrip(".:") if lines else type(error).__name__


def free_space(path: Path) -> str:
    """Return the free space, such as "12.3 GB", on the disk of a file or folder, which need not exist."""
    existing = next((p for p in (path, *path.parents) if os.path.exists(p)), Path())  # Path.exists may raise.
    return f"{shutil.disk_usage(existing).free / 1e9:.1f} GB"
