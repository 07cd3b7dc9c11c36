"""The configuration: its documentation, the presets and how nerfstudio finds them."""

from __future__ import annotations

import ast
import dataclasses
import inspect
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

import sadgs_ns.plugin.model
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.plugin import presets
from sadgs_ns.plugin.model import OF_RAYS, WITHOUT_EFFECT, SadgsModel, SadgsModelConfig
from sadgs_ns.plugin.optimizers import FusedAdamOptimizerConfig, RunLengthDecaySchedulerConfig
from sadgs_ns.plugin.pipeline import SadgsPipelineConfig
from sadgs_ns.plugin.presets import load_preset
from sadgs_ns.plugin.trainer import SadgsTrainerConfig

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

CHECKOUT = Path(__file__).parents[2]
METHODS = ("sadgs", "sadgs-indoor", "sadgs-large", "sadgs-paper", "sadgs-paper-indoor")
CONFIG_CLASSES = (
    SadgsTrainerConfig,
    SadgsPipelineConfig,
    SadgsModelConfig,
    StructureAwareStrategy,
    FusedAdamOptimizerConfig,
    RunLengthDecaySchedulerConfig,
)
WITHOUT_NERFSTUDIO = (
    "strategy",
    "structure_tensor",
    "eta",
    "split",
    "statistics",
    "absgs",
    "splatter",
    "rasterization",
    "losses",
    "initialization",
)


def body_of(cls: type) -> list[ast.stmt]:
    """The statements of a class, as written."""
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    assert isinstance(definition, ast.ClassDef)
    return definition.body


def is_string(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def python(code: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True, timeout=60)


def changed(value: Any) -> Any:
    """Another value of the same type."""
    return not value if isinstance(value, bool) else value + 1


def model(config: SadgsModelConfig) -> SadgsModel:
    return config.setup(scene_box=SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3])), num_train_data=1, seed_points=None)


@pytest.mark.parametrize("cls", CONFIG_CLASSES)
def test_every_public_field_is_followed_by_a_docstring(cls: type):
    body = body_of(cls)
    undocumented = [
        ast.unparse(statement.target)
        for statement, following in zip(body, [*body[1:], ast.Pass()], strict=True)
        if isinstance(statement, ast.AnnAssign)
        and not ast.unparse(statement.target).startswith("_")
        and not is_string(following)
    ]
    assert is_string(body[0]) and undocumented == []


@pytest.mark.parametrize("cls", CONFIG_CLASSES)
def test_every_class_attribute_is_a_dataclass_field(cls: type):
    body = body_of(cls)
    assert not [ast.unparse(statement) for statement in body if isinstance(statement, ast.Assign)]
    annotated = {ast.unparse(statement.target) for statement in body if isinstance(statement, ast.AnnAssign)}
    assert annotated and annotated <= {field.name for field in dataclasses.fields(cls)}


def test_nerfstudio_finds_the_methods_through_their_entry_points():
    installed = {point.name: point.value for point in entry_points(group="nerfstudio.method_configs")}
    assert set(METHODS) <= set(installed)
    for name in METHODS:
        assert installed[name].startswith("sadgs_ns.plugin.presets:")
        assert isinstance(all_methods[name], SadgsTrainerConfig)
        assert all_methods[name].method_name == name


@pytest.mark.parametrize("name", METHODS)
def test_presets_load_under_their_own_names_with_every_optimizer(name: str):
    method = load_preset(name)
    assert method.config.method_name == name
    assert method.description.startswith("Structure-aware densification")
    groups = set(model(dataclasses.replace(SadgsModelConfig(), num_random=10, use_bilateral_grid=True)).gauss_params)
    assert set(method.config.optimizers) == groups | {"camera_opt", "bilateral_grid"}


def test_presets_differ_where_their_comments_say():
    views = [load_preset(name).config.pipeline.views_per_iteration for name in METHODS]  # type: ignore[attr-defined]
    assert views == [1, 4, 1, 1, 2]
    assert [load_preset(name).config.max_num_iterations for name in METHODS] == [3000, 2000, 7000, 3000, 3000]


def test_the_indoor_preset_does_in_2000_iterations_as_many_densification_steps_as_the_default_in_3000():
    indoor: Any = load_preset("sadgs-indoor").config
    for schedule in (StructureAwareStrategy(), indoor.pipeline.model.strategy):
        assert schedule.structure_every == 5 * schedule.absgs_every
        assert schedule.refine_stop_iter == 16 * schedule.absgs_every
        assert schedule.reset_every == 12 * schedule.absgs_every and schedule.refine_start_iter == schedule.absgs_every
        assert schedule.absgs_every == 10 * schedule.eta_every
    stop = indoor.pipeline.model.strategy.refine_stop_iter
    assert stop <= indoor.max_num_iterations * 19 // 30, "fit_to_run shortens nothing"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("max_iterations: 3", r"p\.yaml: unknown key 'max_iterations'; known are .*max_num_iterations.*\."),
        ("pipeline: {model: {tau: 1}}", r"p\.yaml: pipeline: model: unknown key 'tau'; known are .*\."),
        ("max_num_iterations: 3.5", r"p\.yaml: max_num_iterations must be of type int, got float 3\.5\."),
        ("max_num_iterations: true", r"p\.yaml: max_num_iterations must be of type int, got bool True\."),
        ("pipeline: 3", r"p\.yaml: pipeline must be of type SadgsPipelineConfig, got int 3\."),
    ],
)
def test_preset_errors_are_one_sentence_that_names_file_key_and_value(
    text: str, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "p.yaml").write_text(f"description: A preset.\noptimizers: {{}}\n{text}\n")
    monkeypatch.setattr(presets, "_configs", lambda: tmp_path)
    with pytest.raises(ValueError) as error:
        load_preset("p")
    assert re.fullmatch(sentence, str(error.value))


def test_an_unknown_optimizer_option_names_its_group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "p.yaml").write_text("description: A preset.\noptimizers: {means: {schedule: {final: 1.0}}}\n")
    monkeypatch.setattr(presets, "_configs", lambda: tmp_path)
    with pytest.raises(ValueError, match=r"p\.yaml: optimizers\.means\.schedule: unknown key 'final'"):
        load_preset("p")


def test_a_missing_preset_is_named():
    with pytest.raises(FileNotFoundError, match=r"sadgs-none\.yaml"):
        load_preset("sadgs-none")


@pytest.mark.parametrize("name", WITHOUT_EFFECT)
def test_inherited_fields_without_effect_are_refused(name: str):
    config = SadgsModelConfig(num_random=10)
    setattr(config, name, changed(getattr(config, name)))
    with pytest.raises(ValueError, match=rf"pipeline\.model\.{name} has no effect on this method; use \w"):
        model(config)


def test_training_at_reduced_resolution_is_refused():
    with pytest.raises(ValueError, match=r"num_downscales must be 0"):
        model(SadgsModelConfig(num_random=10, num_downscales=2))


def test_every_inherited_splatfacto_field_is_read_or_refused():
    ours = inspect.getsource(sadgs_ns.plugin.model)
    overridden = set(vars(SadgsModel)) - set(re.findall(r"super\(\)\.(\w+)", ours))
    methods = [m for name, m in vars(SplatfactoModel).items() if inspect.isfunction(m) and name not in overridden]
    read = set(re.findall(r"config\.(\w+)", ours + "".join(inspect.getsource(method) for method in methods)))
    inherited = {name for name in SplatfactoModelConfig.__annotations__ if not name.startswith("_")}
    assert inherited - read == set(WITHOUT_EFFECT) - read


@pytest.mark.parametrize("method", ["sadgs", "sadgs-indoor"])
def test_the_help_of_ns_train_shows_the_docstrings(method: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stopped:
        tyro.cli(AnnotatedBaseConfigUnion, args=[method, "--help"])
    assert stopped.value.code == 0
    shown = " ".join(re.sub(r"[^\w\s.-]", " ", capsys.readouterr().out).split())
    assert "--pipeline.model.strategy.max-gaussians" in shown
    assert "Hard cap on the number of Gaussians" in shown
    assert "Training views rendered for one optimizer step" in shown


@pytest.mark.parametrize("cls", CONFIG_CLASSES)
def test_help_texts_break_their_lines_between_sentences_as_tyro_does_not_join_them(cls: type):
    texts = [s.value.value for s in body_of(cls)[1:] if is_string(s)]  # type: ignore[attr-defined]
    assert texts and not [text for text in texts if not all(line.endswith(".") for line in text.strip().splitlines())]


def test_the_help_says_what_replaces_splatfacto_s_options_and_explains_every_other(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        tyro.cli(AnnotatedBaseConfigUnion, args=["sadgs", "--help"])
    lines = [line.strip("│ ") for line in re.sub(r"\x1b\[[\d;]*m", "", capsys.readouterr().out).splitlines()]
    texts = {line.split()[0]: lines[i + 1 : i + 5] for i, line in enumerate(lines) if re.match("--[a-z]", line)}
    for name, replacement in WITHOUT_EFFECT.items():
        text = " ".join(texts[f"--pipeline.model.{name.replace('_', '-')}"])
        assert text.startswith("Splatfacto's, refused here: ") and replacement.removeprefix("nothing: ") in text
    assert "--pipeline.model.strategy.tau-split" in texts
    assert not [option for option in texts for name in OF_RAYS if name.replace("_", "-") in option]
    unexplained = [option for option, text in texts.items() if text[0].startswith("(default:")]
    # nerfstudio keeps optimizers in a dictionary, whose entries have no documentation.
    assert [option for option in unexplained if not re.fullmatch(r"--optimizers\.[\w-]+\.scheduler", option)] == []


def test_the_device_is_the_cpu_where_there_is_no_cuda(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert load_preset("sadgs").config.machine.device_type == "cpu"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert load_preset("sadgs").config.machine.device_type == "cuda"


def test_the_strategy_and_all_it_needs_import_without_nerfstudio(tmp_path: Path):
    names = ", ".join(f"sadgs_ns.{name}" for name in WITHOUT_NERFSTUDIO)
    result = python(f"import sys; sys.modules['nerfstudio'] = None; import {names}; print('done')", tmp_path)
    assert result.stdout.strip() == "done", result.stderr


def test_presets_are_found_in_a_checkout_that_is_not_installed(monkeypatch: pytest.MonkeyPatch):
    def not_installed(package: str) -> Path:
        raise ModuleNotFoundError(package)

    monkeypatch.setattr(presets, "files", not_installed)
    assert presets._configs() == CHECKOUT / "configs"
    assert load_preset("sadgs").config.method_name == "sadgs"


def test_an_installation_holds_every_preset_where_the_package_looks_for_it(tmp_path: Path):
    source, installed = tmp_path / "source", tmp_path / "installed"
    source.mkdir()
    for name in ("sadgs_ns", "configs", "README.md", "LICENSE"):
        (source / name).symlink_to(CHECKOUT / name)
    # setuptools before 77, as Python 3.11 brings it, knows no license of PEP 639; pip fetches a later one.
    lines = (CHECKOUT / "pyproject.toml").read_text().splitlines()
    (source / "pyproject.toml").write_text("\n".join(line for line in lines if not line.startswith("license")))
    build = python(f"import setuptools; setuptools.setup(script_args=['build_py', '-d', {str(installed)!r}])", source)
    assert build.returncode == 0, build.stderr
    shipped = [*CHECKOUT.glob("configs/**/*.yaml"), *CHECKOUT.glob("configs/bench/baselines/*.json")]
    for path in shipped:
        assert (installed / "sadgs_ns" / path.relative_to(CHECKOUT)).read_bytes() == path.read_bytes()
    look = "from importlib.resources import files; print(files('sadgs_ns.configs') / 'sadgs.yaml')"
    assert (installed / "sadgs_ns" / "py.typed").is_file()
    assert python(look, installed).stdout.strip() == str(installed / "sadgs_ns" / "configs" / "sadgs.yaml")


def requirements(lines: list[str]) -> set[str]:
    """Distribution names of requirements, normalised."""
    return {re.split(r"[^\w.-]", line)[0].lower().replace("_", "-") for line in lines if "extra ==" not in line}


def test_everything_imported_is_required_by_us_or_by_nerfstudio():
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
    ours = requirements(project["dependencies"]) | requirements(requires("nerfstudio") or [])
    ours |= {"triton"}  # of torch, where there is one; looked for before it is imported
    for_tests = ours | requirements(project["optional-dependencies"]["dev"])
    local = {"sadgs_ns", *(path.stem for path in (CHECKOUT / "tests").glob("*.py"))}
    distributions = packages_distributions()
    undeclared = []
    for path in [*CHECKOUT.glob("sadgs_ns/**/*.py"), *CHECKOUT.glob("tests/**/*.py")]:
        allowed = ours if path.is_relative_to(CHECKOUT / "sadgs_ns") else for_tests
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
            for module in {name.partition(".")[0] for name in names} - sys.stdlib_module_names - local:
                of = {name.lower().replace("_", "-") for name in distributions.get(module, [module])}
                undeclared += [] if of & allowed else [f"{path.name}: {module}"]
    assert undeclared == []


def test_the_changelog_begins_with_the_version_and_so_does_the_citation():
    version = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]["version"]
    first = re.search(r"^## \[(.+?)\] - (unreleased|\d{4}-\d\d-\d\d)$", (CHECKOUT / "CHANGELOG.md").read_text(), re.M)
    assert first is not None and first[1] == version
    assert f"\nversion: {version}\n" in (CHECKOUT / "CITATION.cff").read_text()


def test_continuous_integration_runs_what_ci_run_does_on_every_python():
    workflow = yaml.safe_load((CHECKOUT / ".github" / "workflows" / "tests.yml").read_text())
    job = workflow["jobs"]["tests"]
    assert [step["run"] for step in job["steps"] if "run" in step] == [".ci/run"]
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
    named = [line.rpartition(" ")[2] for line in project["classifiers"] if re.search(r":: 3\.\d+$", line)]
    assert job["strategy"]["matrix"]["python-version"] == named == ["3.10", "3.11", "3.12"]


def test_pre_commit_checks_what_make_lint_does():
    hooks = yaml.safe_load((CHECKOUT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    lint = (CHECKOUT / "Makefile").read_text().partition("\nlint:")[2].partition("\n\n")[0]
    assert [" ".join(hook["entry"].split()[:2]) for hook in hooks] == [
        ".venv/bin/ruff check", ".venv/bin/ruff format", ".venv/bin/pyright --pythonpath"
    ]  # fmt: skip
    assert re.findall(r"\$\(BIN\)/(\w+ \S+)", lint) == ["ruff check", "ruff format", "pyright --pythonpath"]


def test_the_papers_presets_are_sadgs_without_what_we_added():
    config: Any = load_preset("sadgs").config
    paper, indoor = (load_preset(name).config for name in ("sadgs-paper", "sadgs-paper-indoor"))
    model = config.pipeline.model
    assert model.ssim_lambda > 0.2 and model.opacity_reg > 0 and model.strategy.child_scale > 1
    model.ssim_lambda, model.opacity_reg, model.strategy.child_scale = 0.2, 0.0, 1.0
    model.strategy.clone_grad2d, model.strategy.split_absgrad2d = 2e-4, 4e-4
    model.strategy.min_opacity, model.strategy.refine_stop_iter = 0.005, 1900
    model.strategy.absgs_long_axis = False
    config.optimizers["scales"]["optimizer"].lr = 0.01
    config.method_name = "sadgs-paper"
    assert yaml.dump(config) == yaml.dump(paper)
    config.pipeline.views_per_iteration = 2
    for group, rate in (("scales", 0.005), ("quats", 0.001)):
        config.optimizers[group]["optimizer"].lr = rate
        config.optimizers[group]["scheduler"] = RunLengthDecaySchedulerConfig(initial_factor=3.0, final_factor=0.5)
    config.method_name = "sadgs-paper-indoor"
    assert yaml.dump(config) == yaml.dump(indoor)


@pytest.mark.parametrize("base", ["nothing", "../pyproject", "sadgs-paper", "mine", "x" * 300, 3])
def test_a_base_that_is_no_plain_preset_is_named(base: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for path in (CHECKOUT / "configs").glob("*.yaml"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "mine.yaml").write_text(yaml.dump({"base": base, "description": "mine"}))
    monkeypatch.setattr(presets, "_configs", lambda: tmp_path)
    with pytest.raises(ValueError, match=r"^mine\.yaml: base "):
        load_preset("mine")
