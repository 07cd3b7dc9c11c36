"""The configuration: its documentation, the presets and how nerfstudio finds them."""

from __future__ import annotations

import ast
import copy
import dataclasses
import inspect
import os
import re
import subprocess
import sys
import textwrap
from importlib.metadata import entry_points, packages_distributions, requires
from pathlib import Path
from typing import Any

import pytest
import torch
import tyro
import yaml
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion, all_methods
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig

from helpers.forked_python import HANGS
from helpers.generators import seeded
from helpers.refusals import refusal
from sadgs_ns.errors import InputError
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.training import initial_gaussians, presets
from sadgs_ns.training import model as model_module
from sadgs_ns.training.config import (
    PoseOptimizerConfig,
    SadgsDatamanagerConfig,
    SadgsMachineConfig,
    SadgsModelConfig,
    SadgsPipelineConfig,
    SadgsTrainerConfig,
    SadgsViewerConfig,
)
from sadgs_ns.training.model import SadgsModel
from sadgs_ns.training.run import planning, stereo_start
from sadgs_ns.training.step.optimizers import FusedAdamOptimizerConfig, RunLengthDecaySchedulerConfig

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

CHECKOUT = Path(__file__).parents[2]
NO_OPTIONS = {"windows", "world"}
"""Attributes of the strategy that are decided in each run."""
METHODS = ("sadgs", "sadgs-paper", "sadgs-paper-indoor")
CONFIG_CLASSES = (
    SadgsTrainerConfig,
    SadgsMachineConfig,
    SadgsViewerConfig,
    SadgsPipelineConfig,
    SadgsDatamanagerConfig,
    SadgsModelConfig,
    PoseOptimizerConfig,
    StructureAwareStrategy,
    FusedAdamOptimizerConfig,
    RunLengthDecaySchedulerConfig,
)


def body_of(cls: type) -> list[ast.stmt]:
    """The statements of a class, as written."""
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    assert isinstance(definition, ast.ClassDef)
    return definition.body


def is_string(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def python(code: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True, timeout=HANGS)


def preset(name: str) -> Any:
    """A copy of a preset's configuration."""
    return copy.deepcopy(all_methods[name])


@pytest.fixture(scope="module")
def helps() -> dict[str, str]:
    """What `ns-train METHOD --help` prints, which hides options only in a process that is started for help."""
    code = f"""
import contextlib, sys
sys.argv[:] = ["ns-train", "sadgs", "--help"]
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
for method in {METHODS}:
    with contextlib.suppress(SystemExit):
        tyro.cli(AnnotatedBaseConfigUnion, args=[method, "--help"])
    print("END")
"""
    environment = os.environ | {"CUDA_VISIBLE_DEVICES": ""}
    command = [sys.executable, "-W", "ignore", "-c", code]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=HANGS)
    assert run.returncode == 0, run.stderr
    return dict(zip(METHODS, run.stdout.split("END\n"), strict=False))


def shown_options(method: str, helps: dict[str, str]) -> dict[str, str]:
    """Options that `ns-train METHOD --help` shows, without those of the data's parser, and the text beside each."""
    lines = [line.strip("│ ") for line in re.sub(r"\x1b\[[\d;]*m", "", helps[method]).splitlines()]
    options: dict[str, str] = {}
    name = ""
    for line in lines:
        if re.match("--[a-z]|-h, --help", line):
            name = line.split()[0]
            options[name] = ""
        elif line.startswith("╰"):
            name = ""
        elif name:
            options[name] += f" {line}"
    return options


def model(config: SadgsModelConfig) -> SadgsModel:
    return config.setup(scene_box=SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3])), num_train_data=1, seed_points=None)


@pytest.mark.parametrize("cls", CONFIG_CLASSES)
def test_every_public_field_is_followed_by_a_docstring(cls: type):
    body = body_of(cls)
    undocumented = []
    for statement, following in zip(body, [*body[1:], ast.Pass()], strict=True):
        if not isinstance(statement, ast.AnnAssign):
            continue
        name = ast.unparse(statement.target)
        if not name.startswith("_") and not is_string(following):
            undocumented.append(name)
    assert is_string(body[0])
    assert undocumented == []


@pytest.mark.parametrize("cls", CONFIG_CLASSES)
def test_every_class_attribute_is_a_dataclass_field(cls: type):
    body = body_of(cls)
    assigned = {ast.unparse(target) for each in body if isinstance(each, ast.Assign) for target in each.targets}
    assert assigned <= NO_OPTIONS
    annotated = {ast.unparse(statement.target) for statement in body if isinstance(statement, ast.AnnAssign)}
    assert annotated
    assert annotated <= {field.name for field in dataclasses.fields(cls)}


def test_nerfstudio_finds_the_methods_through_their_entry_points():
    installed = {point.name: point.value for point in entry_points(group="nerfstudio.method_configs")}
    assert set(METHODS) <= set(installed)
    for name in METHODS:
        assert installed[name].startswith("sadgs_ns.training.presets:")
        assert isinstance(all_methods[name], SadgsTrainerConfig)
        assert all_methods[name].method_name == name


@pytest.mark.parametrize("name", METHODS)
def test_presets_have_their_own_names_and_every_optimizer(name: str):
    method = getattr(presets, name.replace("-", "_"))
    assert method.config.method_name == name
    assert method.description.startswith("Structure-aware densification")
    groups = set(model(dataclasses.replace(SadgsModelConfig(), num_random=10)).gauss_params)
    actual = set(method.config.optimizers)
    assert actual == groups | {"poses", "color_matrices"}


def test_presets_differ_where_their_comments_say():
    assert [preset(name).pipeline.views_per_iteration for name in METHODS] == [None, 1, 2]
    assert [preset(name).max_num_iterations for name in METHODS] == [None, 3000, 3000]
    assert [preset(name).rates_follow_views for name in METHODS] == [True, False, False]


def test_presets_share_nothing_that_one_of_them_could_change():
    seen: set[int] = set()

    def look(value: Any) -> None:
        if dataclasses.is_dataclass(value) or isinstance(value, dict):
            assert id(value) not in seen
            seen.add(id(value))
            for inner in value.values() if isinstance(value, dict) else vars(value).values():
                if not isinstance(inner, type):
                    look(inner)

    for name in METHODS:
        look(all_methods[name])


def test_what_splatfacto_s_methods_read_of_its_configuration_is_there():
    ours = "".join(inspect.getsource(module) for module in (model_module, initial_gaussians, stereo_start, planning))
    overridden = set(vars(SadgsModel)) - set(re.findall(r"super\(\)\.(\w+)", ours))
    methods = [m for name, m in vars(SplatfactoModel).items() if inspect.isfunction(m) and name not in overridden]
    used = [m for m in methods if m.__name__ not in ("_get_downscale_factor", "_downscale_if_required")]
    sources = ours + "".join(inspect.getsource(method) for method in used)
    read = {*re.findall(r"config\.(\w+)", sources), *re.findall(r"pipeline\.model\.(\w+)", sources)}
    options = {option.name for option in dataclasses.fields(SadgsModelConfig) if not option.name.startswith("_")}
    assert {name for name in read if name in vars(SplatfactoModelConfig())} <= options
    assert options <= read, "an option that nothing reads"


@pytest.mark.parametrize("method", METHODS)
def test_the_help_shows_at_most_70_options_each_with_a_sentence(method: str, helps: dict[str, str]):
    options = shown_options(method, helps)
    assert len(options) <= 71  # `-h` is one of them
    assert "Hard cap on the number of Gaussians" in options["--pipeline.model.strategy.max-gaussians"]
    assert "Training views rendered for one optimizer step" in options["--pipeline.views-per-iteration"]
    texts = {name: text.partition("(default:")[0].strip() for name, text in options.items() if name != "-h,"}
    actual = {name: text for name, text in texts.items() if not re.search(r"\w+ \w+.*\.$", text)}
    assert actual == {}


def test_the_help_shows_what_users_of_splatfacto_look_for_and_of_optimizers_only_the_rates(helps: dict[str, str]):
    options = shown_options("sadgs", helps)
    expected = """
        data output-dir experiment-name vis viewer.websocket-port viewer.websocket-host max-num-iterations
        steps-per-save load-dir load-checkpoint load-config machine.seed machine.device-type machine.num-devices
        pipeline.model.poses pipeline.model.color-model pipeline.model.backend
        pipeline.model.background-color pipeline.model.sh-degree pipeline.model.random-init pipeline.model.num-random
    """
    assert {f"--{name}" for name in expected.split()} <= set(options)
    hidden = re.compile(
        "warmup|downscale|mixed-precision|logging|accumulation|collider|prompt|eps$|max-norm|weight-decay|share-url"
    )
    actual = [name for name in options if hidden.search(name)]
    assert actual == []
    rates = {name.rpartition(".")[2] for name in options if name.startswith("--optimizers.")}
    assert rates == {"lr", "final-factor"}


HIDDEN_OPTIONS = """
    --project-name mine --viewer.make-share-url True --load-scheduler False --logging.steps-per-log 50
    --logging.local-writer.max-log-size 0 --steps-per-eval-batch 7 --viewer.camera-frustum-scale 0.2
    --pipeline.datamanager.max-thread-workers 2 --pipeline.model.color-corrected-metrics True
    --optimizers.means.optimizer.eps 1e-8 --optimizers.means.scheduler.max-steps 500
"""


def test_options_that_the_help_hides_are_accepted():
    """nerfstudio's users have them in their commands."""
    config: Any = tyro.cli(AnnotatedBaseConfigUnion, args=["sadgs", *HIDDEN_OPTIONS.split()])
    config.check()
    assert config.project_name == "mine"
    assert config.load_scheduler is False
    assert config.steps_per_eval_batch == 7
    assert config.logging.steps_per_log == 50
    assert config.logging.local_writer.max_log_size == 0
    assert config.viewer.make_share_url
    assert config.viewer.camera_frustum_scale == 0.2
    assert config.pipeline.datamanager.max_thread_workers == 2
    assert config.pipeline.model.color_corrected_metrics
    means = config.optimizers["means"]
    assert means["optimizer"].eps == 1e-8
    assert means["scheduler"].max_steps == 500


@pytest.mark.hard_case("nerfstudio's options that cannot work here, such as `mixed-precision`", "refused, with why")
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("--mixed-precision True", r"mixed_precision must be False, since sadgs trains in float32"),
        ("--prompt chair", r"prompt has no effect here, since a capture is trained on its photos, not on a text"),
        ("--relative-model-dir weights", r"relative_model_dir has no effect here, since other commands look for"),
        ("--machine.machine-rank 1", r"machine\.machine_rank has no effect here, since torchrun starts runs"),
        ("--machine.num-machines 2", r"machine\.num_machines must be 1, since `torchrun"),
        ("--viewer.num-rays-per-chunk 64", r"viewer\.num_rays_per_chunk has no effect here, since Gaussians"),
        ("--pipeline.datamanager.train-cameras-sampling-seed 7", r"sampling_seed .*, since machine\.seed sets it"),
        ("--pipeline.datamanager.images-on-gpu True", r"images_on_gpu has no effect here, since cache_images says"),
        ("--pipeline.datamanager.eval-image-indices 3", r"eval_image_indices has no effect here, since ns-eval"),
        ("--optimizers.means.optimizer.weight-decay 0.1", r"weight_decay must be left out"),
    ],
)
def test_options_that_the_help_hides_and_that_cannot_work_say_why(words: str, sentence: str):
    config: Any = tyro.cli(AnnotatedBaseConfigUnion, args=["sadgs", *words.split()])
    with refusal(sentence):
        config.check()


@pytest.mark.parametrize("cls", CONFIG_CLASSES)
def test_help_texts_break_their_lines_between_sentences_as_tyro_does_not_join_them(cls: type):
    texts = [s.value.value for s in body_of(cls)[1:] if is_string(s)]  # type: ignore[attr-defined]
    assert texts
    for text in texts:
        for line in text.strip().splitlines():
            assert line.endswith("."), text


def test_small_images_bound_the_number_of_starting_points(capsys: pytest.CaptureFixture[str]):
    """Of 100,000 pixels 2 % are 2,000 points, and the box has the least, 2 × 2 a face; a billion bound nothing."""
    generator = seeded(0)
    seed_points = torch.rand((3000, 3), generator=generator), 255 * torch.rand((3000, 3), generator=generator)

    def number(pixels: int | None, **options: Any) -> int:
        config = dataclasses.replace(SadgsModelConfig(), **options)
        params, synthetic = initial_gaussians.initial_gaussians(config, seed_points, pixels)
        assert len(synthetic) == len(params["means"])
        return len(synthetic)

    assert number(100_000) == 2000 + 6 * 2**2
    printed = " ".join(capsys.readouterr().out.split())
    assert "Starting from a random 2,000 of 3,000 SfM points, as all training images have 100,000 px" in (
        printed.replace("pixels", "px")
    )
    assert number(100_000, random_init=True) == 2000
    everything = 3000 + 6 * 16**2
    assert number(10**9) == number(None) == number(100_000, starts_per_pixel=0.0) == everything
    actual = number(10**9, random_init=True)
    assert actual == 50_000
    printed = capsys.readouterr().out
    assert printed == ""


@pytest.mark.hard_case(
    "`sh-degree` 9, `num-random` 10⁹ or `random-scale` out of range; `opacity-reg` ∞ or 10⁹",
    "refused by name",
)
@pytest.mark.parametrize(
    ("option", "value", "sentence"),
    [
        ("sh_degree", 4, "pipeline.model.sh_degree must be in [0, 3], got 4."),
        ("sh_degree", -1, "pipeline.model.sh_degree must be in [0, 3], got -1."),
        ("background_color", "random", "pipeline.model.background_color must be black or white, got random."),
        ("num_random", 0, "pipeline.model.num_random must be in [1, 10,000,000], got 0."),
        ("num_random", 10**9, "pipeline.model.num_random must be in [1, 10,000,000], got 1,000,000,000."),
        ("random_scale", 0.0, "pipeline.model.random_scale must be positive and finite, got 0."),
        ("random_scale", float("nan"), "pipeline.model.random_scale must be positive and finite, got nan."),
        ("ssim_lambda", 1.5, "pipeline.model.ssim_lambda must be in [0, 1], got 1.5."),
        ("initial_opacity", 1.0, "pipeline.model.initial_opacity must be in (0, 1), got 1."),
        ("opacity_reg", -1.0, "pipeline.model.opacity_reg must be in [0, 100], got -1."),
        ("opacity_reg", float("inf"), "pipeline.model.opacity_reg must be in [0, 100], got inf."),
    ],
)
def test_options_of_the_model_that_are_out_of_range_are_refused(option: str, value: Any, sentence: str):
    with pytest.raises(InputError) as refused:
        dataclasses.replace(SadgsModelConfig(), **{option: value}).check()
    assert str(refused.value) == sentence


@pytest.mark.hard_case(
    "`energy-blur` ∞ or 10⁹, `epsilon` ∞; NaN, ∞, −1, 0 and 10⁹ in every numeric option of pipeline, model and "
    "densification",
    "refused by name, or known to train",
)
@pytest.mark.parametrize(
    ("option", "value", "sentence"),
    [
        ("energy_blur", float("inf"), "pipeline.energy_blur must be in [0, 100], got inf."),
        ("energy_blur", -1.0, "pipeline.energy_blur must be in [0, 100], got -1."),
        ("epsilon", float("inf"), "pipeline.epsilon must be positive and finite, got inf."),
        ("memory_budget_gb", 0.0, "pipeline.memory_budget_gb must be positive and finite, got 0."),
    ],
)
def test_options_of_the_pipeline_that_are_out_of_range_are_refused(option: str, value: float, sentence: str):
    with pytest.raises(InputError) as refused:
        dataclasses.replace(SadgsPipelineConfig(), **{option: value}).check()
    assert str(refused.value) == sentence


def test_gaussians_are_neither_added_nor_removed_where_densification_ends_at_0():
    strategy = StructureAwareStrategy(refine_stop_iter=0).for_run(3000)
    for step in range(3000):
        assert not (strategy.observes(step) or strategy.needs_absgrad(step))


def test_the_device_is_the_cpu_where_there_is_no_cuda(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert SadgsTrainerConfig().machine.device_type == "cpu"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert SadgsTrainerConfig().machine.device_type == "cuda"


def test_the_strategy_and_all_it_needs_import_without_nerfstudio(tmp_path: Path):
    names = ", ".join(
        f"sadgs_ns.{folder}.{path.stem}"
        for folder in ("method", "render")
        for path in sorted((CHECKOUT / "sadgs_ns" / folder).glob("[a-z]*.py"))
    )
    result = python(f"import sys; sys.modules['nerfstudio'] = None; import {names}; print('done')", tmp_path)
    assert result.stdout.strip() == "done", result.stderr


# --- the package ---


def test_what_is_decided_in_a_run_is_no_option():
    assert not NO_OPTIONS & {option.name for option in dataclasses.fields(StructureAwareStrategy)}


def test_an_installation_holds_every_module_and_nothing_that_measures(tmp_path: Path):
    source = tmp_path / "source"
    installed = tmp_path / "installed"
    source.mkdir()
    for name in ("sadgs_ns", "benchmarks", "examples", "configs", "README.md", "LICENSE"):
        (source / name).symlink_to(CHECKOUT / name)
    # setuptools before 77, as Python 3.11 brings it, knows no license of PEP 639; pip fetches a later one.
    lines = (CHECKOUT / "pyproject.toml").read_text().splitlines()
    (source / "pyproject.toml").write_text("\n".join(line for line in lines if not line.startswith("license")))
    build = python(f"import setuptools; setuptools.setup(script_args=['build_py', '-d', {str(installed)!r}])", source)
    assert build.returncode == 0, build.stderr
    assert (installed / "sadgs_ns/py.typed").is_file()
    modules = {path.relative_to(CHECKOUT) for path in CHECKOUT.glob("sadgs_ns/**/*.py")}
    actual = {path.relative_to(installed) for path in installed.glob("**/*.py")}
    assert actual == modules


def requirements(lines: list[str]) -> set[str]:
    """Distribution names of requirements, normalised."""
    return {re.split(r"[^\w.-]", line)[0].lower().replace("_", "-") for line in lines if "extra ==" not in line}


def test_everything_imported_is_required_by_us_or_by_nerfstudio():
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
    ours = requirements(project["dependencies"]) | requirements(requires("nerfstudio") or [])
    ours |= {"triton"}  # looked for before it is imported; torch has it
    folders = ("sadgs_ns", "benchmarks", "examples", "tests")
    # Python 3.10 has no tomllib, for which tomli stands there.
    extras = project["optional-dependencies"]
    for_tests = ours | requirements(extras["all"] + extras["dev"] + extras["docs"])
    local = {*folders, "helpers", "tomllib", *(path.stem for path in (CHECKOUT / "tests").rglob("*.py"))}
    distributions = packages_distributions()
    undeclared = []
    for path in [path for folder in folders for path in CHECKOUT.glob(f"{folder}/**/*.py")]:
        allowed = ours if path.is_relative_to(CHECKOUT / "sadgs_ns") else for_tests
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
            for module in {name.partition(".")[0] for name in names} - sys.stdlib_module_names - local:
                of = {name.lower().replace("_", "-") for name in distributions.get(module, [module])}
                undeclared += [] if of & allowed else [f"{path.name}: {module}"]
    assert undeclared == []


def test_continuous_integration_runs_what_ci_run_does_on_every_python():
    workflow = yaml.safe_load((CHECKOUT / ".github/workflows/tests.yml").read_text())
    job = workflow["jobs"]["tests"]
    runs = [step["run"] for step in job["steps"] if "run" in step]
    assert runs == [".ci/run"]
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
    named = [line.rpartition(" ")[2] for line in project["classifiers"] if re.search(r":: 3\.\d+$", line)]
    assert job["strategy"]["matrix"]["python-version"] == named == ["3.10", "3.11", "3.12", "3.13"]


def test_pre_commit_checks_what_make_lint_does():
    hooks = yaml.safe_load((CHECKOUT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    lint = (CHECKOUT / "Makefile").read_text().partition("\nlint:")[2].partition("\n\n")[0]
    actual = [" ".join(hook["entry"].split()[:2]) for hook in hooks]
    assert actual == [
        ".venv/bin/ruff check", ".venv/bin/ruff format", ".venv/bin/pyright --pythonpath"
    ]  # fmt: skip
    actual = re.findall(r"\$\(BIN\)/(\w+ \S+)", lint)
    assert actual == ["ruff check", "ruff format", "pyright --pythonpath"]


def test_the_papers_presets_are_sadgs_without_what_we_added():
    config = preset("sadgs")
    paper = preset("sadgs-paper")
    indoor = preset("sadgs-paper-indoor")
    model = config.pipeline.model
    assert model.ssim_lambda > 0.2
    assert model.opacity_reg > 0
    assert model.strategy.child_scale > 1
    model.ssim_lambda = 0.2
    model.opacity_reg = 0.0
    model.strategy.child_scale = 1.0
    model.averaged_share = model.max_angular_scale = 0.0
    model.near_plane = "scene"
    model.stereo_points = 0
    model.starts_per_pixel = 0.0
    model.clear_paths = False
    model.dropout = 0.0
    model.strategy.clone_grad2d = 2e-4
    model.strategy.split_absgrad2d = 4e-4
    model.strategy.structure_every = 500
    model.strategy.absgs_every = 100
    model.strategy.reset_every = 1200
    model.strategy.min_opacity = 0.005
    model.strategy.refine_start_iter = 100
    model.strategy.refine_stop_iter = 1900
    model.strategy.absgs_long_axis = False
    model.strategy.eta_every = model.strategy.min_observations = 1
    model.strategy.split_min_opacity = config.pipeline.energy_blur = 0.0
    config.pipeline.epsilon = 1e-6
    config.max_num_iterations = 3000
    config.pipeline.views_per_iteration = 1
    config.rates_follow_views = False
    config.optimizers["scales"]["optimizer"].lr = 0.01
    for group in ("features_dc", "features_rest", "opacities"):
        del config.optimizers[group]["scheduler"]
    config.method_name = "sadgs-paper"
    assert yaml.dump(config) == yaml.dump(paper)
    config.pipeline.views_per_iteration = 2
    for group, rate in (("scales", 0.005), ("quats", 0.001)):
        config.optimizers[group]["optimizer"].lr = rate
        config.optimizers[group]["scheduler"] = RunLengthDecaySchedulerConfig(initial_factor=3.0, final_factor=0.5)
    config.method_name = "sadgs-paper-indoor"
    assert yaml.dump(config) == yaml.dump(indoor)
