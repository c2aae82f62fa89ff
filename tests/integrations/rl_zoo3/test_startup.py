"""The startup finder, in interpreters of environments that have the package installed."""

import shutil
from pathlib import Path

import pytest
from installation import REPOSITORY, Environment, build

ALGORITHMS = "import rl_zoo3.utils; print('policyflow' in rl_zoo3.utils.ALGOS)"
FINDERS = "import sys; print([type(f).__name__ for f in sys.meta_path].count('ZooFinder'))"

pytestmark = pytest.mark.slow


def packages(environment: Environment) -> list[str]:
    """The folders of an environment's packages, for an interpreter that does not look for them."""
    borrowed = (environment.site_packages / "zz_borrowed.pth").read_text()
    return [str(environment.site_packages), *borrowed.splitlines()]


@pytest.mark.parametrize("options", [[], ["-I"], ["-P", "-s", "-E"], ["-O"]])
def test_startup_puts_one_finder_in_place(
    installed: Environment, tmp_path: Path, options: list[str]
) -> None:
    assert installed.run(*options, "-c", FINDERS, folder=tmp_path) == "1\n"


def test_startup_and_gymnasium_import_nothing_of_ours(
    installed: Environment, tmp_path: Path
) -> None:
    heavy = "import sys, gymnasium; print(sys.modules.keys() & {'torch', 'sb3_policyflow', 'yaml'})"
    assert installed.run("-c", heavy, folder=tmp_path) == "set()\n"
    stem = "import sys; print([m for m in sys.modules if 'policyflow' in m])"
    assert installed.run("-c", stem, folder=tmp_path) == "['sb3_policyflow_startup']\n"


def test_the_switch_turns_it_off(installed: Environment, tmp_path: Path) -> None:
    off = {"SB3_POLICYFLOW_ZOO": "0"}
    assert installed.run("-c", FINDERS, folder=tmp_path, **off) == "0\n"
    imported = "import sb3_policyflow; " + FINDERS
    assert installed.run("-c", imported, folder=tmp_path, **off) == "0\n"


def test_without_site_the_package_is_imported_first(installed: Environment, tmp_path: Path) -> None:
    """The documentation's way with ``pip install --target``."""
    code = (
        "import sys; sys.path += {path!r}; sys.argv[1:] = ['--help']\n"
        "import sb3_policyflow; from rl_zoo3.train import train; train()"
    )
    output = installed.run("-S", "-c", code.format(path=packages(installed)), folder=tmp_path)
    assert "policyflow" in output


def test_without_site_an_import_of_the_package_catches_up(
    installed: Environment, tmp_path: Path
) -> None:
    code = (
        "import sys; sys.path += {path!r}\n"
        "import rl_zoo3.utils, rl_zoo3.hyperparams_opt, rl_zoo3.exp_manager\n"
        "assert 'policyflow' not in rl_zoo3.utils.ALGOS\n"
        "import sb3_policyflow\n"
        "assert 'policyflow' in rl_zoo3.hyperparams_opt.HYPERPARAMS_SAMPLER\n"
        "assert hasattr(rl_zoo3.exp_manager.ExperimentManager.__init__, '__wrapped__')\n"
        "print('policyflow' in rl_zoo3.utils.ALGOS)"
    )
    output = installed.run("-S", "-c", code.format(path=packages(installed)), folder=tmp_path)
    assert output.endswith("True\n")


def test_reloaded_module_is_registered_with_again_and_wrapped_once(
    installed: Environment, tmp_path: Path
) -> None:
    code = (
        "import importlib, rl_zoo3.utils as utils, rl_zoo3.exp_manager as m\n"
        "importlib.reload(utils); importlib.reload(m)\n"
        "import sb3_policyflow_startup; sb3_policyflow_startup.install()\n"
        "construct = m.ExperimentManager.__init__\n"
        "print('policyflow' in utils.ALGOS, hasattr(construct.__wrapped__, '__wrapped__'))"
    )
    assert installed.run("-c", code, folder=tmp_path).endswith("True False\n")


def test_a_second_package_with_the_same_trick(installed: Environment, tmp_path: Path) -> None:
    """Its finder asks all finders for the module too, and so would ours: neither may loop."""
    code = (
        "import sys, sb3_policyflow_startup as ours\n"
        "seen = []\n"
        "class Other(ours.ZooFinder):\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        seen.append(name)\n"
        "        return super().find_spec(name, path, target)\n"
        "sys.meta_path.insert(0, Other()); sys.meta_path.append(Other())\n"
        "import rl_zoo3.utils\n"
        "assert 'rl_zoo3.utils' in seen\n"
        "print('policyflow' in rl_zoo3.utils.ALGOS)"
    )
    assert installed.run("-c", code, folder=tmp_path).endswith("True\n")


def test_rl_zoo3_in_a_zip_file(installed: Environment, tmp_path: Path) -> None:
    """zipimport gives all modules of an archive the same loader."""
    archive = tmp_path / "archive"
    package = archive / "rl_zoo3"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "utils.py").write_text("import rl_zoo3.other\nALGOS = {}\n")
    (package / "other.py").write_text("")
    shutil.make_archive(str(archive), "zip", archive)
    code = f"import sys; sys.path.insert(0, {f'{archive}.zip'!r}); {ALGORITHMS}"
    assert installed.run("-W", "error", "-c", code, folder=tmp_path).endswith("True\n")


def test_worker_processes_know_the_environments(installed: Environment, tmp_path: Path) -> None:
    tmp_path.joinpath("script.py").write_text(
        "import gymnasium\n"
        "from stable_baselines3.common.vec_env import SubprocVecEnv\n"
        "def make():\n"
        "    import rl_zoo3.utils\n"
        "    return gymnasium.make('MultiGoal-v0')\n"
        "if __name__ == '__main__':\n"
        "    env = SubprocVecEnv([make], start_method='spawn')\n"
        "    print(env.reset().shape); env.close()\n"
    )
    assert installed.run("script.py", folder=tmp_path).endswith("(1, 4)\n")


def test_a_broken_package_is_said_and_harms_nobody(
    environment: Environment, tmp_path: Path
) -> None:
    broken = environment.site_packages / "sb3_policyflow/policyflow/policyflow.py"
    broken.write_text("raise OSError('disk on fire')\n")
    options = ["--env", "Pendulum-v1", "-n", "64", "--eval-freq", "-1"]
    quick = ["-params", "n_envs:1", "n_steps:64", "n_epochs:1"]
    train = ["-m", "rl_zoo3.train", *options, *quick]
    output = environment.run(*train, "--algo", "ppo", folder=tmp_path)
    assert "RuntimeWarning: sb3_policyflow could not register with rl_zoo3.utils" in output
    assert "OSError: disk on fire" in output
    assert "Saving to logs/ppo/Pendulum-v1_1" in output
    output = environment.run(*train, "--algo", "policyflow", folder=tmp_path, status=2)
    assert "invalid choice: 'policyflow'" in output


def test_a_broken_rl_zoo3_is_said(installed: Environment, tmp_path: Path) -> None:
    package = tmp_path / "rl_zoo3"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "utils.py").write_text("print('of another version')\n")
    output = installed.run("-c", "import rl_zoo3.utils", folder=tmp_path)
    assert "could not register with rl_zoo3.utils" in output
    assert "AttributeError" in output


def test_a_missing_rl_zoo3_is_just_missing(installed: Environment, tmp_path: Path) -> None:
    (tmp_path / "rl_zoo3.py").write_text("")
    output = installed.run("-c", "import rl_zoo3.utils", folder=tmp_path, status=1)
    assert output.count("Error") == 1
    assert "ModuleNotFoundError: No module named 'rl_zoo3.utils'" in output


def test_files_that_lost_their_package_are_silent(environment: Environment, tmp_path: Path) -> None:
    (environment.site_packages / "sb3_policyflow_startup.py").unlink()
    assert environment.run("-c", "print('fine')", folder=tmp_path) == "fine\n"


def test_uninstalling_leaves_nothing(environment: Environment, tmp_path: Path) -> None:
    environment.run("-c", ALGORITHMS, folder=tmp_path)
    environment.pip("uninstall", "-y", "sb3-policyflow")
    assert not list(environment.site_packages.glob("*policyflow*"))
    assert environment.run("-c", FINDERS, folder=tmp_path) == "0\n"


def test_editable_install_and_a_checkout_that_moved(tmp_path: Path) -> None:
    checkout, moved = tmp_path / "checkout", tmp_path / "moved"
    for name in ("sb3_policyflow", "hyperparams"):
        shutil.copytree(REPOSITORY / name, checkout / name)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPOSITORY / name, checkout / name)
    wheel = build("editable", tmp_path, checkout)
    environment = Environment.create(tmp_path / "environment").install(wheel)
    where = "import inspect, rl_zoo3.utils as u; print(inspect.getfile(u.ALGOS['policyflow']))"
    output = environment.run("-c", where, folder=tmp_path)
    assert output.endswith(f"{checkout}/sb3_policyflow/policyflow/policyflow.py\n")
    module = "sb3_policyflow.integrations.rl_zoo3.experiment"
    config = f"from {module} import hyperparams_folder as f; print(f())"
    assert environment.run("-c", config, folder=tmp_path) == f"{checkout}/hyperparams\n"

    checkout.rename(moved)
    assert environment.run("-c", "import gymnasium", folder=tmp_path) == ""
    output = environment.run("-c", ALGORITHMS, folder=tmp_path)
    assert "sb3_policyflow could not register with rl_zoo3.utils" in output
    assert output.endswith("False\n")


def test_start_file_names_the_same_function() -> None:
    """Python 3.15 and later read it instead of the .pth file."""
    start, pth = (
        (
            REPOSITORY / f"sb3_policyflow/integrations/rl_zoo3/startup/sb3_policyflow.{suffix}"
        ).read_text()
        for suffix in ("start", "pth")
    )
    assert start == "sb3_policyflow_startup:install\n"
    assert "import sb3_policyflow_startup" in pth
    assert "sb3_policyflow_startup.install()" in pth
