"""The recipes for CI as printed: the steps of action.yml, Dockerfile, the hooks and docs/nightly.md are run.

Only what pip fetches is left out: PIP_* variables keep it from looking for dependencies, which are those of the tests.
"""

import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from run_samples import truncate, write_models

yaml = pytest.importorskip("yaml", reason="PyYAML is not installed: the extra dev has it")

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "nightly.md").read_text(encoding="utf-8")
RECIPES = [yaml.safe_load(block) for block in re.findall(r"```yaml\n(.*?)```", PAGE, flags=re.DOTALL)]
ACTION = yaml.safe_load((ROOT / "action.yml").read_text(encoding="utf-8"))
HOOKS = {hook["id"]: hook for hook in yaml.safe_load((ROOT / ".pre-commit-hooks.yaml").read_text(encoding="utf-8"))}
BASH = ["bash", "--noprofile", "--norc", "-eo", "pipefail", "-c"]  # as GitHub starts it
RECONSTRUCT = "import shutil, sys\nshutil.copytree('nightly/models', sys.argv[2])\n"  # stands for COLMAP

pytestmark = pytest.mark.skipif(importlib.util.find_spec("hatchling") is None, reason="hatchling is not installed")


def workflows(key):
    return [recipe for recipe in RECIPES if key in recipe]


def steps(workflow):
    return workflow["jobs"]["reconstruct"]["steps"]


@pytest.fixture(scope="module")
def pip_env():
    """Let pip build with the hatchling that is here, and leave dependencies alone."""
    # Python finds the dependencies of this environment from any other one
    folders = {str(Path(importlib.util.find_spec(name).origin).parents[1]) for name in ("numpy", "hatchling")}
    pip = {"PIP_NO_DEPS": "1", "PIP_NO_BUILD_ISOLATION": "0", "PIP_DISABLE_PIP_VERSION_CHECK": "1", "PIP_NO_INDEX": "1"}
    own = {"PYTHONPATH": os.pathsep.join(folders), "PYTHONWARNINGS": "", "SFM_AUDIT_KERNELS": "0"}  # nothing to compile
    return {**os.environ, **pip, **own}


def origin(python, env, cwd):
    """Return the file from which a Python imports sfm_audit."""
    command = [*python, "-c", "import sfm_audit; print(sfm_audit.__file__)"]
    return subprocess.run(command, env=env, cwd=cwd, capture_output=True, text=True, check=True).stdout


def run_step(script, cwd, env):
    done = subprocess.run([*BASH, script], cwd=cwd, env=env, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


def run_action_step(index, cwd, env, **inputs):
    """Run a step of the action as GitHub does: inputs come in through the environment of the step."""
    step = ACTION["runs"]["steps"][index]
    given = {name: str(spec.get("default", "")) for name, spec in ACTION["inputs"].items()} | inputs
    own = {
        name: re.sub(r"\$\{\{ inputs\.([\w-]+) \}\}", lambda match: given[match[1]], value)
        for name, value in step.get("env", {}).items()
    }
    assert not any("${{" in value for value in own.values())
    return run_step(step["run"], cwd, {**env, **own})


@pytest.fixture(scope="module")
def machine(tmp_path_factory, pip_env):
    """A runner on which the action has installed sfm-audit."""
    temp = tmp_path_factory.mktemp("runner")
    env = {**pip_env, "RUNNER_TEMP": str(temp), "GITHUB_ACTION_PATH": str(ROOT)}
    code, said = run_action_step(0, temp, env, python=sys.executable)
    assert code == 0, said
    assert origin([temp / "sfm-audit/bin/python"], env, temp).startswith(str(temp))
    return {**env, "PATH": f"{temp}/sfm-audit/bin:{env['PATH']}"}


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    write_models(folder, ("a",))
    return folder


@pytest.fixture
def repository(tmp_path, photos):
    """A user's repository as the recipes want it."""
    nightly = tmp_path / "nightly"
    shutil.copytree(photos, nightly / "models")
    (nightly / "gate.toml").write_text("limits.max_share_rejected = 1.0\n", encoding="utf-8")
    (nightly / "reconstruct.py").write_text(RECONSTRUCT, encoding="utf-8")
    return tmp_path


def test_the_action_passes_and_fails_as_the_gate_does(repository, machine):
    summary = repository / "summary.md"
    env = {**machine, "GITHUB_STEP_SUMMARY": str(summary)}
    inputs = {"paths": "nightly/models\n\n", "policy-file": "nightly/gate.toml", "arguments": "--policy camera"}
    code, said = run_action_step(1, repository, env, **inputs)
    assert code == 0, said
    assert "audit: passed" in summary.read_text(encoding="utf-8")
    assert json.loads((repository / "sfm-audit-run.gate.json").read_bytes())["passed"]
    assert (repository / "sfm-audit-run.junit.xml").exists()
    assert json.loads((repository / "sfm-audit-run/run.json").read_bytes())["config"]["policy"] == "camera"
    (repository / "nightly/gate.toml").write_text("limits.min_images = 100\n", encoding="utf-8")
    code, said = run_action_step(1, repository, env, **inputs)
    assert code == 1, said
    assert "audit: failed" in summary.read_text(encoding="utf-8")


def test_the_action_judges_what_could_be_read_and_fails(repository, machine):
    truncate(next((repository / "nightly/models").rglob("points3D.bin")))
    env = {**machine, "GITHUB_STEP_SUMMARY": str(repository / "summary.md")}
    assert run_action_step(1, repository, env, paths="nightly/models")[0] == 3
    assert run_action_step(1, repository, env, paths="")[0] == 2


def test_the_workflow_gives_the_action_inputs_that_it_has():
    every = [step for workflow in workflows("jobs") for step in steps(workflow)]
    (step,) = [step for step in every if "sfm-audit@" in step.get("uses", "")]
    assert set(step["with"]) <= set(ACTION["inputs"])
    assert {name for name, spec in ACTION["inputs"].items() if spec.get("required")} <= set(step["with"])


def baseline(repository, machine):
    """Audit what the recipes will find, so that there is something to compare with."""
    shutil.copytree(repository / "nightly/models", repository / "out/photos")
    code, said = run_step("sfm-audit run out/photos -o nightly/baseline --quiet", repository, machine)
    assert code == 0, said
    shutil.rmtree(repository / "out")


def run_all(scripts, repository, env):
    """Run the steps of a recipe one after the other; pip only looks whether it could install."""
    env = {**env, "SFM_AUDIT": ROOT.as_uri(), "PIP_DRY_RUN": "1", "GITHUB_STEP_SUMMARY": str(repository / "summary.md")}
    for script in scripts:
        code, said = run_step(script, repository, env)
        assert code == 0, (script, said)


def test_the_workflow_by_hand_runs(repository, machine):
    (workflow,) = [each for each in workflows("jobs") if "env" in each["jobs"]["reconstruct"]]
    scripts = [step["run"] for step in steps(workflow) if "run" in step]
    assert any(script.startswith("pip install") for script in scripts)
    baseline(repository, machine)
    run_all(scripts, repository, machine)
    assert "audit: passed" in (repository / "summary.md").read_text(encoding="utf-8")


def test_the_gitlab_job_runs(repository, machine):
    (workflow,) = workflows("nightly")
    baseline(repository, machine)
    run_all(workflow["nightly"]["script"], repository, machine)
    for path in [*workflow["nightly"]["artifacts"]["paths"], workflow["nightly"]["artifacts"]["reports"]["junit"]]:
        assert (repository / path).exists(), path


def test_the_hooks_run_with_the_arguments_of_the_page(repository, machine):
    (recipe,) = workflows("repos")
    (repository / "nightly/models").rename(repository / "models")
    (repository / "nightly/gate.toml").rename(repository / "gate.toml")
    for used in recipe["repos"][0]["hooks"]:
        hook = HOOKS[used["id"]]
        code, said = run_step(shlex.join([*shlex.split(hook["entry"]), *used["args"]]), repository, machine)
        assert (code, hook["pass_filenames"]) == (0, False), said
        assert re.search(used["files"], "models/sparse/0/images.bin")


def test_the_steps_of_the_dockerfile_make_a_command_line(tmp_path, pip_env):
    lines = (ROOT / "Dockerfile").read_text(encoding="utf-8").replace("\\\n", " ").splitlines()
    steps = [line.removeprefix("RUN ") for line in lines if line.startswith("RUN ")]
    source = tmp_path / "src"
    source.mkdir()
    ignore = (ROOT / ".dockerignore").read_text(encoding="utf-8").split()
    assert ignore[0] == "*"
    for name in [line[1:] for line in ignore if line.startswith("!")]:  # COPY . . under .dockerignore
        path = ROOT / name
        if path.is_dir():
            shutil.copytree(path, source / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            (source / name).parent.mkdir(exist_ok=True)
            shutil.copy(path, source / name)
    site = tmp_path / "site"
    env = {**pip_env, "PATH": f"{Path(sys.executable).parent}:{pip_env['PATH']}"}
    for script in steps:
        place = {**env, "PIP_TARGET": str(site)} if "install" in script else env
        code, said = run_step(script.replace("/wheel", str(tmp_path / "wheel")), source, place)
        assert code == 0, said
    said = dict(line.split(" ", 1) for line in lines if line.startswith(("ENTRYPOINT", "CMD")))
    entry, command = json.loads(said["ENTRYPOINT"]), json.loads(said["CMD"])
    assert (entry, command) == (["sfm-audit"], ["--help"])
    env["PYTHONPATH"] = f"{site}{os.pathsep}{env['PYTHONPATH']}"
    assert origin([sys.executable], env, tmp_path).startswith(str(site))
    done = subprocess.run([site / "bin" / entry[0], *command], env=env, capture_output=True, text=True, check=True)
    assert "Commands" in done.stdout
