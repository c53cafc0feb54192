"""Who may know whom, who knows ROS, and that what is public says what it does."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {
    "srtomo_core": set(),
    "srtomo_rtc": {"srtomo_core"},
    "srtomo_srtc": {"srtomo_core"},
    "srtomo_sim": {"srtomo_core"},
    "srtomo_ops": {"srtomo_core", "srtomo_rtc", "srtomo_srtc", "srtomo_sim"},
}
"""Each package with those that it may import: a plant that shared the reconstructor's model would prove nothing."""

ROS = ("rclpy", "msgs_schema", "std_msgs", "std_srvs", "lifecycle_msgs", "rcl_interfaces", "diagnostic_msgs")
MAY_IMPORT_ROS = (
    "srtomo_rtc/node.py",
    "srtomo_rtc/hot.py",  # the node's hot endpoints
    "srtomo_rtc/recorder_node.py",
    "srtomo_sim/node.py",
    "srtomo_srtc/node.py",
    "srtomo_srtc/listener.py",  # the node's hot endpoints
    "srtomo_ops/operator.py",  # calls the nodes
    "srtomo_ops/dither.py",  # asks the HRTC for it
    "srtomo_ops/publish.py",
    "srtomo_ops/demo.py",
    "srtomo_ops/commands/ctl.py",
    "srtomo_ops/commands/nodes.py",  # says which parameter a node refused
    "srtomo_ops/commands/bench.py",  # asks whether it is there
    "srtomo_ops/bench/path.py",
    "srtomo_ops/bench/path_node.py",
    "srtomo_ops/bench/soak_drive.py",
)
WITHOUT_ROS = [name for name in PACKAGES if name != "srtomo_ops"]

MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def imported(path: Path) -> set[str]:
    """Top-level names of everything that a module imports, wherever in it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name_of(path)}: relative import"
            names.add((node.module or "").split(".")[0])
    return names


@pytest.mark.parametrize("package", PACKAGES)
def test_who_may_know_whom(package):
    for path in (ROOT / package).rglob("*.py"):
        others = imported(path) & set(PACKAGES) - {package}
        assert others <= PACKAGES[package], f"{name_of(path)} imports {others - PACKAGES[package]}"
        assert "tests" not in imported(path), name_of(path)


def test_who_knows_ros():
    knowing = {name_of(path) for path in MODULES if imported(path) & set(ROS)}
    assert knowing <= set(MAY_IMPORT_ROS), f"{knowing - set(MAY_IMPORT_ROS)} must run without ROS"


@pytest.mark.parametrize("package", WITHOUT_ROS)
def test_what_is_no_node_runs_without_ros(package):
    """Also at run time, and through what it imports: ROS is made impossible to import."""
    modules = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in (ROOT / package).rglob("*.py")
        if name_of(path) not in MAY_IMPORT_ROS and path.name != "__init__.py"
    ]
    code = (
        "import importlib, sys\n"
        f"for name in {ROS!r}: sys.modules[name] = None\n"
        f"for name in {modules!r}: importlib.import_module(name)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=100, check=False
    )
    assert done.returncode == 0, done.stderr


def public_without_docstring(path: Path) -> list[str]:
    """Public functions, classes and methods of a module, and the module itself, that do not say what they are."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    found = [] if ast.get_docstring(tree) else [name_of(path)]

    def look(node: ast.AST) -> None:
        for child in ast.iter_child_nodes(node):
            if not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                continue
            # __init__ and its like are described with their class
            if child.name.startswith("_"):
                continue
            if not ast.get_docstring(child):
                found.append(f"{name_of(path)}:{child.lineno} {child.name}")
            if isinstance(child, ast.ClassDef):
                look(child)

    look(tree)
    return found


def test_everything_public_has_a_docstring():
    assert [problem for path in MODULES for problem in public_without_docstring(path)] == []


def test_the_tests_mirror_the_packages():
    folders = {path.name for path in (ROOT / "tests").iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert folders <= {package.removeprefix("srtomo_") for package in PACKAGES}
