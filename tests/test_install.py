"""The package can be reached from other people's folders, and all but the environments works without PyBullet."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from planning import Goal

ROOT = Path(__file__).resolve().parents[1]
WITHOUT_PYBULLET = "import sys; sys.modules['pybullet'] = None\n"


def run(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a program in a folder, which its imports find first."""
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": paths},
    )


needs_pybullet = pytest.mark.skipif(find_spec("pybullet") is None, reason="PyBullet is not installed")


@pytest.fixture
def own_project(tmp_path: Path) -> Path:
    """A project with folders of our names."""
    for name in ("envs", "planning", "experiments"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("MINE = True\n")
    return tmp_path


MAKE = "import gymnasium as gym; env = gym.make('textocvp.envs:PutBlockInBowl-v0', **{})\n"


@needs_pybullet
def test_environments_are_made_and_played_beside_other_folders_of_their_name(own_project: Path) -> None:
    code = MAKE.format({"control": "primitive"}) + (
        "from textocvp.envs import Expert; import copy, pickle, sys, envs\n"
        "obs, info = env.reset(seed=3)\n"
        "for action in Expert(env).actions(): *_, info = env.step(action)\n"
        "twin = pickle.loads(pickle.dumps(env))\n"
        "print(info['is_success'], twin.unwrapped.scene == env.unwrapped.scene, envs.MINE, 'torch' in sys.modules)\n"
    )
    done = run(code, own_project)
    assert done.stdout.split() == ["True", "True", "True", "False"], done.stderr


@needs_pybullet
def test_workers_find_the_environments_too(own_project: Path) -> None:
    code = (
        "import gymnasium as gym\n"
        "if __name__ == '__main__':\n"
        "    copies = gym.make_vec('textocvp.envs:PutBlockInBowl-v0', num_envs=2, vectorization_mode='async',\n"
        "                          vector_kwargs={'context': 'spawn'})\n"
        "    print(copies.reset(seed=[1, 2])[1]['instruction'].shape)\n"
        "    copies.close()\n"
    )
    (own_project / "main.py").write_text(code)
    done = run("import runpy; runpy.run_path('main.py', run_name='__main__')", own_project)
    assert done.stdout.strip() == "(2,)", done.stderr
    collect = "--image-size 32 --episodes 2 --workers 2 --out two.h5"
    done = run(
        f"import runpy, sys; sys.argv[1:] = '{collect}'.split()\n"
        "runpy.run_module('textocvp.envs.collect', run_name='__main__', alter_sys=True)",
        own_project,
    )
    assert "2 episodes" in done.stdout, done.stderr


@needs_pybullet
def test_both_names_in_one_program_register_once() -> None:
    code = "import envs, warnings; warnings.simplefilter('error'); import textocvp.envs\n" + MAKE.format({})
    done = run(code + "print(env.spec.entry_point)", ROOT)
    assert done.stdout.strip() == "envs.tabletop:TabletopEnv" and "Warning" not in done.stderr


def test_model_and_planner_do_without_pybullet_beside_other_folders(own_project: Path) -> None:
    sentence = "put the red block in the blue bowl"
    code = (
        "import textocvp.cli; from textocvp import Rollout, WorldModel; from textocvp.planning import Goal\n"
        f"print(WorldModel.rollout, Goal.parse('{sentence}'), sep=';')"
    )
    done = run(WITHOUT_PYBULLET + code, own_project)
    assert "WorldModel.rollout" in done.stdout, done.stderr
    assert done.stdout.strip().endswith(f";{Goal.parse(sentence)}")


@pytest.mark.parametrize("code", [MAKE.format({}), "import textocvp.envs", "from textocvp.envs import collect"])
def test_environments_say_where_pybullet_can_be_had(code: str, tmp_path: Path) -> None:
    done = run(WITHOUT_PYBULLET + code, tmp_path)
    assert done.returncode == 1 and "conda install -c conda-forge pybullet" in done.stderr.splitlines()[-1]


def test_names_that_there_are_not_are_errors() -> None:
    import textocvp

    with pytest.raises(AttributeError, match="no attribute 'WorldModels'"):
        _ = textocvp.WorldModels
    with pytest.raises(ImportError):
        exec("from textocvp import nothing")
