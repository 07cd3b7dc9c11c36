"""Files from somebody else: what they can execute, where they can write, and who reaches the viewer.

nerfstudio's `config.yml` executes code (it is read with `yaml.Loader`). Our presets (plain Python of the package),
protocols (`yaml.safe_load`), checkpoints (`torch.load(weights_only=True)`), `transforms.json` and COLMAP models do not.
Pillow and plyfile parse images and PLY files.
"""

from __future__ import annotations

import asyncio
import socket
import sys
from contextlib import closing
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.utils import colmap_parsing_utils as colmap
from nerfstudio.scripts.viewer.run_viewer import ViewerConfigWithoutNumRays
from nerfstudio.utils.eval_utils import eval_load_checkpoint, eval_setup
from PIL import Image
from tyro import cli

from benchmarks import protocol, run
from benchmarks.protocol import Row, Scene
from examples.drawn_scene.scene import SPARSE_FOLDER
from helpers.forked_python import HANGS
from helpers.json_files import write_json
from helpers.kill_and_resume import set_up
from sadgs_ns.training import presets
from sadgs_ns.training.config import SadgsDatamanagerConfig, SadgsTrainerConfig
from sadgs_ns.training.run.trainer import SadgsTrainer


class Payload:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


def yaml_payload(path: Path) -> str:
    """YAML that creates a folder when it is loaded by PyYAML's full loader."""
    return f"!!python/object/apply:os.mkdir [{str(path)!r}]\n"


# --- what executes code ---


@pytest.mark.hard_case(
    "`--load-dir` or `--load-checkpoint` with a hostile pickle, also with `TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD=1`",
    "one sentence; nothing is executed",
)
@pytest.mark.parametrize("forced", [False, True])
@pytest.mark.parametrize("option", ["load_dir", "load_checkpoint"])
def test_resuming_from_a_hostile_checkpoint_executes_nothing(
    option: str, forced: bool, config: SadgsTrainerConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    if forced:  # what people set for other methods' checkpoints
        monkeypatch.setenv("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "1")
    checkpoint = tmp_path / "step-000000003.ckpt"
    executed = tmp_path / "executed"
    torch.save({"step": 3, "pipeline": Payload(executed), "optimizers": {}, "scalers": {}}, checkpoint)
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    checkpoint = checkpoint.rename(folder / checkpoint.name)
    setattr(config, option, folder if option == "load_dir" else checkpoint)
    with pytest.raises(
        ValueError, match=r"step-000000003\.ckpt is cut off, damaged or not of tensors and plain values"
    ):
        set_up(config)
    assert not executed.exists()
    torch.load(checkpoint, weights_only=False)
    assert executed.exists()  # so it was a hostile one


@pytest.mark.hard_case(
    "`ns-eval`, `ns-render`, `ns-viewer`, `ns-export` with a hostile checkpoint",
    "torch ≥ 2.6 refuses it; nothing is executed",
)
def test_evaluating_a_hostile_checkpoint_executes_nothing(config: SadgsTrainerConfig, tmp_path: Path):
    executed = tmp_path / "executed"
    config.load_dir = tmp_path / "checkpoints"
    config.load_dir.mkdir()
    torch.save({"step": 3, "pipeline": Payload(executed)}, config.load_dir / "step-000000003.ckpt")
    with pytest.raises(Exception, match="Weights only load failed"):
        eval_load_checkpoint(config, None)  # type: ignore[arg-type]
    assert not executed.exists()


@pytest.mark.hard_case(
    "`ns-eval`, `ns-render`, `ns-viewer`, `ns-export` with a hostile `config.yml`",
    "**it is executed**, by nerfstudio, before any code of ours; the README warns",
)
def test_nerfstudio_executes_what_a_config_yml_says_as_the_readme_warns(tmp_path: Path):
    executed = tmp_path / "executed"
    path = tmp_path / "config.yml"
    path.write_text(yaml_payload(executed))
    with pytest.raises(AssertionError):  # it is no config, but that comes too late
        eval_setup(path)
    assert executed.exists()


@pytest.mark.hard_case("a protocol with Python tags", "one line; nothing is executed")
def test_a_hostile_protocol_executes_nothing(tmp_path: Path):
    (tmp_path / "p.yaml").write_text(f"scenes: {yaml_payload(tmp_path / 'executed')}")
    with pytest.raises(ValueError, match=r"p\.yaml is not YAML: .*python/object/apply"):
        protocol.load(tmp_path / "p.yaml")
    assert not (tmp_path / "executed").exists()


# --- where files are written ---


@pytest.mark.hard_case(
    "a protocol whose experiment, timestamp, checkpoint, log or viewer path leads out of the run's folder",
    "the run is refused in one sentence",
)
@pytest.mark.parametrize(
    "overrides",
    [
        {"experiment_name": "../../../elsewhere"},
        {"timestamp": "../../../elsewhere"},
        {"relative_model_dir": "/elsewhere"},
        {"logging.relative_log_dir": "../../../../elsewhere"},
        {"viewer.relative_log_filename": "../../../../elsewhere"},
    ],
)
def test_a_protocol_cannot_write_outside_its_run_s_folder(overrides: dict[str, Any], scene: Path, tmp_path: Path):
    where = Scene("demo", scene.name, "colmap", {"colmap_path": str(SPARSE_FOLDER)})
    run.build_config(where, Row("r", "sadgs"), 0, scene.parent, tmp_path)
    with pytest.raises(
        ValueError, match=r"row 'r' on 'demo': it would write .*elsewhere.*, outside the run's folder\."
    ):
        run.build_config(where, Row("r", "sadgs", overrides), 0, scene.parent, tmp_path)


def rename_first_image(scene: Path, copy: Path, name: str, text: bool) -> ColmapDataParserConfig:
    """A copy of the scene's COLMAP model whose first image has another name."""
    model = copy / SPARSE_FOLDER
    model.mkdir(parents=True)
    (copy / "images").symlink_to(scene / "images")
    cameras, images, points = colmap.read_model(str(scene / SPARSE_FOLDER), ".bin")  # type: ignore
    images[1] = images[1]._replace(name=name)
    colmap.write_model(cameras, images, points, str(model), ".txt" if text else ".bin")
    return ColmapDataParserConfig(data=copy, colmap_path=Path(SPARSE_FOLDER), downscale_factor=1)


@pytest.mark.hard_case(
    "a COLMAP image named `../../x`, `/etc/x`, `` `id`.png ``, `$(…).png`",
    "refused before nerfstudio downscales (it runs ffmpeg through a shell) or renders by that name",
)
@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(
    "name",
    ["../../000.png", "a/../../000.png", "/etc/000.png", "$(touch${IFS}x).png", "`id`.png", '"0.png', "a\\b.png"],
)
def test_image_names_that_leave_their_folder_or_reach_a_shell_are_refused(
    name: str, text: bool, scene: Path, tmp_path: Path
):
    parser = rename_first_image(scene, tmp_path / "copy", name, text)
    with pytest.raises(ValueError) as error:
        SadgsDatamanagerConfig(dataparser=parser).setup(device="cpu")
    assert "images." in str(error.value)
    assert repr(name) in str(error.value)
    assert "\n" not in str(error.value)


def transforms(folder: Path, names: list[str]) -> NerfstudioDataParserConfig:
    """A tiny dataset whose images have these paths, relative to its folder."""
    folder.mkdir()
    frames = []
    for index, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (8, 8)).save(folder / name)
        pose = np.eye(4)
        pose[0, 3] = index
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    meta = {"fl_x": 8, "fl_y": 8, "cx": 4, "cy": 4, "w": 8, "h": 8, "frames": frames}
    write_json(folder / "transforms.json", meta)
    return NerfstudioDataParserConfig(data=folder, downscale_factor=1, eval_mode="all")


@pytest.mark.hard_case(
    "an image of `transforms.json` that lies apart from the others by way of `..`",
    "refused: `ns-render dataset` would write outside its output folder; all images in `../images` are fine",
)
def test_an_image_apart_from_the_others_by_dots_is_refused(tmp_path: Path):
    names = [f"images/{i}.png" for i in range(4)]
    parser = transforms(tmp_path / "data", [*names, "images/../../secret/4.png"])
    with pytest.raises(ValueError, match=r"secret/4\.png leads out of .*/data/images, where the other images are"):
        SadgsDatamanagerConfig(dataparser=parser).setup(device="cpu")
    beside = transforms(tmp_path / "beside", [f"../images/{i}.png" for i in range(4)])
    assert len(SadgsDatamanagerConfig(dataparser=beside).setup(device="cpu").train_dataset) == 4  # as people have them


@pytest.mark.hard_case("a saved config of an older version", "gets the datamanager that checks the images' names")
def test_saved_configs_make_the_datamanager_with_the_checks():
    for name in ("sadgs", "sadgs_paper", "sadgs_paper_indoor"):
        datamanager: FullImageDatamanagerConfig = getattr(presets, name).config.pipeline.datamanager
        assert datamanager._target is SadgsDatamanagerConfig()._target  # what nerfstudio puts into a loaded config


# --- the viewer ---


def answers(host: str, port: int) -> bool:
    with closing(HTTPConnection(host, port, timeout=HANGS)) as connection:
        try:
            connection.request("GET", "/")
        except ConnectionRefusedError:
            return False
        connection.getresponse().read()
        return True


def shut_down(trainer: SadgsTrainer) -> None:
    """Stop trainer and viewer once the viewer's server has let go of its connections.

    viser stops the server at any moment and from another thread than the server's. Connections that were then just
    accepted or already closed leave errors, which the garbage collector reports in a later test.
    """
    assert trainer.viewer_state is not None
    viser_server: Any = trainer.viewer_state.viser_server
    server = viser_server._websock_server._ws_server

    async def close() -> None:
        while server.websockets:
            await asyncio.sleep(0.01)
        server.close()
        await server.wait_closed()

    asyncio.run_coroutine_threadsafe(close(), server.get_loop()).result(timeout=HANGS)
    trainer.shutdown()


@pytest.mark.hard_case("the viewer of `ns-train`", "listens on 127.0.0.1; `--viewer.websocket-host 0.0.0.0` opens it")
@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere 127.0.0.2 is no address of this machine")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # viser's, in its thread: as an error it would never start
@pytest.mark.parametrize(("host", "open_to_all"), [(None, False), ("0.0.0.0", True)])
def test_the_viewer_answers_only_on_loopback_unless_told_otherwise(
    host: str | None, open_to_all: bool, config: SadgsTrainerConfig
):
    config.vis = "viewer"
    if host is not None:
        config.viewer.websocket_host = host
    with socket.create_server(("127.0.0.1", 0)) as free:  # nerfstudio's own search leaves sockets open
        config.viewer.websocket_port = free.getsockname()[1]
    config.save_config()  # as ns-train: the viewer wants the folder
    trainer = set_up(config)
    assert trainer.viewer_state is not None
    server = trainer.viewer_state.viser_server
    try:
        port = server.get_port()  # type: ignore[union-attr]
        assert answers("127.0.0.1", port)
        assert answers("127.0.0.2", port) == open_to_all  # only a server on all addresses has this one
    finally:
        shut_down(trainer)


@pytest.mark.hard_case("the help of `ns-train sadgs`", "shows that the viewer listens on 127.0.0.1")
@pytest.mark.parametrize("method", ["sadgs", "sadgs-paper"])
def test_the_help_shows_that_the_viewer_listens_on_loopback(method: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        cli(AnnotatedBaseConfigUnion, args=[method, "--help"])
    _, found, after = capsys.readouterr().out.partition("--viewer.websocket-host")
    assert found
    assert "(default: 127.0.0.1)" in " ".join(after.split())[:200]


@pytest.mark.hard_case(
    "`ns-viewer`", "nerfstudio ignores the run's setting and listens everywhere; the README gives the option"
)
def test_ns_viewer_has_a_host_of_its_own_as_the_readme_warns():
    assert ViewerConfigWithoutNumRays().as_viewer_config().websocket_host == ViewerConfig().websocket_host == "0.0.0.0"


@pytest.mark.hard_case("our own YAML files", "need no more than the safe loader")
def test_no_yaml_of_ours_needs_more_than_the_safe_loader():
    for path in Path(__file__).parents[2].glob("configs/**/*.yaml"):
        assert isinstance(yaml.safe_load(path.read_text()), dict)
