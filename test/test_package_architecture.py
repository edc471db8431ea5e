"""What holds the architecture together: ROS in one folder, declarations in one module, versions and lists that agree."""

from __future__ import annotations

import ast
import configparser
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

import brainshift_ros
from brainshift_ros import graph
from brainshift_ros.cli.main import COMMANDS

ROOT = Path(brainshift_ros.__file__).parent.parent
PACKAGE = ROOT / "brainshift_ros"
MODULES = sorted(path for path in PACKAGE.rglob("*.py"))
CORE = [path for path in MODULES if path.parent.name != "nodes"]

ROS = re.compile(r"^(rclpy|rcl_interfaces|rosidl_\w+|rosgraph_msgs|launch(_ros)?|ament_\w+|tf2_\w+|\w+_(msgs|srvs))(\.|$)")


def imports(path):
    """Absolute names that a module imports, anywhere in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def strings(path):
    """String constants of a module that are not docstrings, with their lines."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    documentation = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documentation:
            yield node.value, node.lineno


def test_the_scan_would_find_ros():
    assert any(ROS.match(name) for name in imports(PACKAGE / "nodes" / "base.py"))
    assert "sensor_msgs/msg/PointCloud2" in {text for text, _ in strings(PACKAGE / "graph.py")}


@pytest.mark.parametrize("path", CORE, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_the_core_names_no_ros_and_no_node(path):
    found = sorted({name for name in imports(path) if ROS.match(name) or name.startswith("brainshift_ros.nodes")})
    assert not found, f"{path.relative_to(ROOT)} imports {found}; only brainshift_ros/nodes may"


def test_the_core_imports_where_no_ros_is_installed():
    modules = [".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in CORE]
    program = f"""
import importlib, re, sys
class Blocked:
    pattern = re.compile({ROS.pattern!r})
    def find_spec(self, name, path=None, target=None):
        if self.pattern.match(name):
            raise ImportError(f"{{name}} is blocked")
for name in list(sys.modules):
    if Blocked.pattern.match(name):
        del sys.modules[name]
sys.meta_path.insert(0, Blocked())
for name in {modules!r}:
    importlib.import_module(name)
print("imported", {len(modules)})
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.stdout.endswith(f"imported {len(modules)}\n"), done.stderr[-2000:]


@pytest.mark.parametrize("path", [p for p in MODULES if p.name != "graph.py"], ids=lambda p: str(p.relative_to(PACKAGE)))
def test_no_topic_name_is_spelt_outside_the_graph(path):
    names = {form for topic in graph.TOPICS for form in (topic.name, f"/{topic.name}") if "/" in form}
    # Words that are also keys of figures and of diagnostics' conditions are names only with their slash.
    found = [(text, line) for text, line in strings(path) if text in names]
    assert not found, f"{path.relative_to(ROOT)}: take it from brainshift_ros.graph"


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_qos_profiles_are_made_in_one_place(path):
    if path.name != "qos.py":
        assert not [name for name in imports(path) if name.startswith("rclpy.qos")]


def test_publishers_and_subscriptions_are_made_in_the_base_and_the_tools_only():
    makers = {"create_publisher", "create_subscription", "create_service"}
    callers = {
        path.name
        for path in MODULES
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Attribute) and node.attr in makers
    }
    assert callers == {"base.py", "replay.py", "record.py"}


def scripts():
    """console_scripts of setup.py, read without running it."""
    for node in ast.walk(ast.parse((ROOT / "setup.py").read_text(encoding="utf-8"))):
        if isinstance(node, ast.keyword) and node.arg == "entry_points":
            entries = ast.literal_eval(node.value)["console_scripts"]
            return dict(re.fullmatch(r"(\w+) = ([\w.]+):main", entry).groups() for entry in entries)
    raise AssertionError("setup.py has no entry_points")


def test_executables_are_the_nodes_and_the_command():
    expected = {node.name: node.module for node in graph.NODES} | {"brainshift": "brainshift_ros.cli.main"}
    assert scripts() == expected


@pytest.mark.parametrize("module", [*scripts().values(), "brainshift_ros.nodes.replay", "brainshift_ros.nodes.record"])
def test_each_executable_exists_and_runs_as_a_module(module):
    text = (ROOT / (module.replace(".", "/") + ".py")).read_text(encoding="utf-8")
    assert "\ndef main() -> None:" in text
    assert '\nif __name__ == "__main__":\n    main()' in text


def test_package_xml_names_every_ros_package_in_use():
    tree = ElementTree.parse(ROOT / "package.xml")
    assert tree.getroot().get("format") == "3"
    assert tree.findtext("license") == "Apache-2.0"
    depends = {item.text for item in tree.iter() if item.tag in ("depend", "exec_depend")}
    sources = [*(PACKAGE / "nodes").glob("*.py"), *(ROOT / "launch_scripts").glob("*.py")]
    used = {name.split(".")[0] for path in sources for name in imports(path) if ROS.match(name)}
    used |= {topic.type.split("/")[0] for topic in graph.TOPICS} | {service.type.split("/")[0] for service in graph.SERVICES}
    assert used <= depends


def test_versions_agree():
    version = brainshift_ros.__version__
    assert ElementTree.parse(ROOT / "package.xml").findtext("version") == version


def test_ros2_run_would_look_where_colcon_installs():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    assert config["develop"]["script_dir"] == config["install"]["install_scripts"] == "$base/lib/brainshift_ros"
    assert (ROOT / "resource" / "brainshift_ros").is_file()


def test_each_subcommand_is_a_module_with_a_command():
    for name, (module, _) in COMMANDS.items():
        path = ROOT / (module.replace(".", "/") + ".py")
        assert path.is_file(), f"brainshift {name} has no module"


#: Folder of the core -> folders that it may import: data flows one way (docs/architecture.md).
MAY_IMPORT = {
    "image": set(),
    "segmentation": {"image"},
    "surface": {"image"},
    "septa": {"image", "surface"},
    "mesh": {"image", "segmentation", "surface", "septa"},
    "solvers": set(),
    "mechanics": {"image", "surface", "mesh", "solvers"},
    "atlas": {"image", "mesh", "mechanics", "solvers"},
    "registration": {"surface"},
    "vessels": {"registration"},
    "correspondence": {"registration", "vessels"},
    "session": {"surface", "atlas", "registration", "vessels", "correspondence", "wire"},
    "field": {"image", "surface", "mesh"},
    "inverse": {"solvers", "mesh", "atlas", "correspondence", "field"},
    "evaluation": {"image", "surface", "septa"},
}


@pytest.mark.parametrize("folder", MAY_IMPORT)
def test_data_flows_one_way(folder):
    folders = {path.name for path in PACKAGE.iterdir() if path.is_dir()}
    used = {
        parts[1]
        for path in (PACKAGE / folder).glob("*.py")
        for parts in (name.split(".") for name in imports(path) if name.startswith("brainshift_ros."))
        if parts[1] in folders
    }
    assert used <= MAY_IMPORT[folder] | {folder}
