"""What was installed is what the tree says."""

import ast
import importlib
import re
import sys
from importlib import metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("srtomo_core", "srtomo_rtc", "srtomo_srtc", "srtomo_sim", "srtomo_ops")
ROS = {"ament_index_python", "domain_coordinator", "diagnostic_msgs", "lifecycle_msgs", "msgs_schema", "rcl_interfaces"}
ROS |= {"builtin_interfaces", "rclpy", "std_msgs", "std_srvs"}


def installed() -> metadata.Distribution:
    try:
        return metadata.distribution("srtomo")
    except metadata.PackageNotFoundError:
        pytest.skip("srtomo is not installed")


def test_versions_agree():
    stated = re.search(r'^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    package = re.search(r"<version>(.+)</version>", (ROOT / "msgs_schema/package.xml").read_text())
    assert stated and package
    assert stated[1] == package[1] == installed().version


@pytest.mark.parametrize("kind", ["msg", "srv"])
def test_installed_messages_are_those_of_the_tree(kind: str):
    pytest.importorskip("rclpy")
    built = importlib.import_module(f"msgs_schema.{kind}")
    in_tree = {path.stem: path.read_text() for path in (ROOT / "msgs_schema" / kind).glob(f"*.{kind}")}
    assert {name for name in vars(built) if name[0].isupper() and "_" not in name} == set(in_tree)
    share = Path(built.__file__).parents[5] / "share/msgs_schema" / kind
    assert {path.stem: path.read_text() for path in share.glob(f"*.{kind}")} == in_tree, "install again"


def test_every_import_is_a_declared_dependency():
    declared = {re.match(r"[\w-]+", line)[0].lower() for line in installed().requires or () if "extra ==" not in line}
    modules = {"yaml" if name == "pyyaml" else name for name in declared}
    for path in (path for package in PACKAGES for path in (ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module or ""]
            unknown = {name.split(".")[0] for name in names} - modules - ROS - set(PACKAGES) - sys.stdlib_module_names
            assert not unknown, f"{path.relative_to(ROOT)}:{node.lineno} imports {unknown}"


def test_instruments_are_shipped():
    files = {str(path) for path in installed().files or ()}
    if any(name.startswith("srtomo_core/") for name in files):  # not an editable installation
        in_tree = {str(path.relative_to(ROOT)) for path in (ROOT / "srtomo_core/systems").glob("*.yaml")}
        assert in_tree <= files
