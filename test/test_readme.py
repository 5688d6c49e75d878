# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What README and docs show runs: every command and every piece of Python, page by page.

A page's blocks run in their order in one temporary folder. `tsobs` runs as it is, or as `SHORTER`
says; an error is the one that the page shows. A node gets its arguments and parameters, and is not
configured; those of the README and of the tutorial run for real. Of a benchmark only the
options are checked. What cannot run here is in `NOT_RUN`.
"""

import re
import runpy
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pytest
from markdown_it import MarkdownIt
from yaml import safe_load

import tsobs_ros as ts
from tsobs_ros.bag import BagReader
from tsobs_ros.cli.main import main
from tsobs_ros.nodes.managed import ManagedNode
from tsobs_ros.nodes.runtime import check_arguments
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]

SHORTER = {
    "tsobs demo --output demo": "tsobs demo --output demo --duration 3 --bias-at 1",
    "tsobs compare --output comparison": (
        "tsobs compare --output comparison --scenario noise --seeds 1 --duration 8"
    ),
    "tsobs compare first_run": "tsobs compare first_run --method certified ekf",
    "tsobs campaign $(tsobs config)/campaign.yaml": (
        "tsobs campaign $(tsobs config)/campaign.yaml --runs 8 --output my_campaign"
    ),
}
"""What runs in place of a command that takes long."""

NOT_RUN = (
    *("git ", "pip ", "source ", "mkdir ", "export ", "rosdep ", "colcon ", "rviz2 "),
    *("python3 ", ".venv/", "/tmp/release/", "cd /tmp ", "POLICY=", "CORE=", "cc ", "./step_log "),
    *("ros2 bag ", "ros2 launch ", "ros2 lifecycle ", "ros2 security ", "tsobs watch"),
    *("python play_motion.py ", "tsobs demo --duration 60 "),
)
"""Beginnings of commands that need the network, a robot, Ubuntu's ROS, the user's folders or
minutes, or that other tests run."""

NODES = ("observer", "recorder", "player", "plant_simulator", "visualizer")
COMMANDS = (
    r"tsobs|ros2|python3?|make|source|mkdir|cp|rosdep|colcon|pip|apt|sudo|export|git|chrt|[A-Z_]+(?==)"
    r"|\.venv/bin/\S+"
)
"""What the first line of a block of commands begins with."""


class Block(NamedTuple):
    """A block of a page: its language, and its text without indentation."""

    language: str
    text: str

    @property
    def commands(self) -> Iterator[tuple[str, str]]:
        """Yield the commands, each with the error that the block shows as its answer, if any."""
        if self.text.startswith("cat > "):
            yield self.text, ""
            return
        lines = self.text.replace("\\\n", " ").splitlines()
        prompts = any(line.startswith("$ ") for line in lines)
        places = [
            place
            for place, line in enumerate(lines)
            if line.strip() and line.startswith("$ ") == prompts
        ]
        for place, after in zip(places, [*places[1:], len(lines)], strict=True):
            answer = "\n".join(["", *lines[place + 1 : after]])
            command = re.sub(r" +# .*", "", lines[place].removeprefix("$ "))
            yield command, "".join(answer.partition("\nerror: ")[1:])


@cache
def blocks(page: Path) -> list[Block]:
    """Return a page's fenced and indented blocks, in order."""
    return [
        Block(token.info or language(token.content), token.content)
        for token in MarkdownIt().parse(page.read_text(encoding="utf-8"))
        if token.type in ("fence", "code_block")
    ]


def language(text: str) -> str:
    """Tell Python and commands from formulas, outputs and tables of commands."""
    first = text.split("\n", 1)[0].removeprefix("$ ")
    if first.startswith(("from ", "import ")):
        return "python"
    if not re.match(rf"({COMMANDS})(\s|$|=)", first):
        return "text"
    return "usage" if re.search(r"\S {2,}[^ #]", first) else "sh"


TUTORIAL, YOUR_ROBOT = (ROOT / "docs" / f"{name}.md" for name in ("tutorial", "your_robot"))
COMMAND_PAGES = [
    page
    for page in PAGES
    if page not in (TUTORIAL, YOUR_ROBOT)
    and any(b.language in ("sh", "yaml") for b in blocks(page))
]
SLOW = pytest.mark.slow
PYTHON_PAGES = [page for page in PAGES if any(b.language == "python" for b in blocks(page))]


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


class Shell:
    """Runs the commands of a page, or checks them as far as they can be."""

    def __init__(
        self, ros: Any, benchmark: Callable[[str], ModuleType], patch: Any, capfd: Any
    ) -> None:
        self._ros, self._benchmark, self._patch, self._capfd = ros, benchmark, patch, capfd
        self.robot: ts.ArmRequest | None = None
        self.printed = dict[str, str]()

    def run_page(self, page: Path) -> None:
        """Run the commands of a page, and give its parameters to their nodes."""
        for number, block in enumerate(blocks(page)):
            if block.language == "sh":
                for command, error in block.commands:
                    self._capfd.readouterr()
                    self.run(command, error)
                    self.printed[command], err = self._capfd.readouterr()
                    assert "unknown parameter" not in err, err
                    assert "Traceback" not in err
                    assert not error or without_folders(error) == without_folders(err)
            elif block.language == "yaml":
                Path(f"{number}.yaml").write_text(block.text, encoding="utf-8")
                (section,) = safe_load(block.text)
                name = section.strip("/*") or "observer"
                self.check_node(name, ["--ros-args", "--params-file", f"{number}.yaml"])
                assert "unknown parameter" not in self._capfd.readouterr().err

    def run(self, command: str, error: str) -> None:
        if command.startswith(NOT_RUN):
            return
        if command.startswith("cat > "):
            target, text, _ = re.split(r" << 'END'\n|END\n", command.removeprefix("cat > "))
            Path(target).write_text(text, encoding="utf-8")
            return
        words = split(SHORTER.get(command, command))
        if words[:3] == ["ros2", "run", "tsobs_ros"]:
            words = words[3:]
        match words:
            case ["tsobs", *arguments]:
                if arguments[0] == "demo":
                    arguments += ["--domain-id", str(self._ros.domain_id)]
                assert main(arguments) == (1 if error else 0), command
            case [name, *arguments] if name in NODES:
                self.check_node(name, arguments)
            case ["python", script, *arguments] if script.startswith("benchmarks/"):
                self.benchmark(Path(script).stem, arguments)
            case ["make", *targets]:
                make = ["make", "--dry-run", "-C", str(ROOT), *targets]
                subprocess.run(make, check=True, capture_output=True)
            case ["cp", source, target]:
                shutil.copy(source, target)
            case ["python", "hidden_robot.py", *arguments]:
                self._patch.setattr(sys, "argv", ["hidden_robot.py", *arguments])
                self.robot = runpy.run_path("hidden_robot.py")["robot"]
            case ["grep", "-v", text, source, ">", target]:
                lines = Path(source).read_text(encoding="utf-8").splitlines(keepends=True)
                Path(target).write_text("".join(each for each in lines if text not in each))
            case _:
                pytest.fail(f"{command}: neither run nor in NOT_RUN")

    def check_node(self, name: str, arguments: Sequence[str]) -> None:
        """Let a node take its arguments and its parameters, without working."""
        module = import_module(f"tsobs_ros.nodes.{name}")
        check_arguments(module, [name, *arguments])
        if "--enclave" not in arguments:  # which is of the context
            node = ManagedNode(
                name, module.Parameters, context=self._ros.context, cli_args=arguments
            )
            node.destroy_node()

    def benchmark(self, name: str, arguments: Sequence[str]) -> None:
        """Let a benchmark read its arguments, and not run."""
        self._patch.setattr(sys, "argv", [name, *arguments, "--no-such-option"])
        with pytest.raises(SystemExit, match="2"):
            self._benchmark(name).main()
        err = self._capfd.readouterr().err
        assert err.endswith("unrecognized arguments: --no-such-option\n"), err


def split(command: str) -> list[str]:
    """Split a command as a shell does that has run `tsobs config`."""
    folder = str(config_path(SHIPPED_DESIGN).parent)
    return shlex.split(command.replace("$(tsobs config)", folder).replace("$PWD", str(Path.cwd())))


def without_folders(text: str) -> list[str]:
    """Return the words of an error from where it begins, paths without their folders."""
    begin = text.find("error: ")
    return [word.rpartition("/")[2] for word in text[begin:].split()] if begin >= 0 else []


@pytest.fixture(scope="module")
def estimated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bag that the shipped log becomes."""
    bag = tmp_path_factory.mktemp("pages") / "run1"
    ts.estimate_bag(ROOT / "docs" / "examples" / "arm_log.csv", output=bag)
    return bag


@pytest.fixture
def folder(tmp_path: Path, estimated: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The files that pages name without making them."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(ROOT / "docs" / "examples" / "arm_log.csv", tmp_path)
    for name in ("my_arm", "stiff", "soft", "arm", "elbow"):
        shutil.copy(config_path(SHIPPED_DESIGN), tmp_path / f"{name}.design.yaml")
    for name in ("observer.yaml", "paper_example_1.design.yaml"):
        shutil.copy(config_path(name), tmp_path)
    for bag in ("run1", "bag"):
        shutil.copytree(estimated, bag)
    return tmp_path


@pytest.fixture
def tools(ros: Any, benchmark: Any, monkeypatch: Any, capfd: Any) -> tuple[Any, ...]:
    """What a `Shell` takes."""
    return ros, benchmark, monkeypatch, capfd


@pytest.mark.parametrize(
    "page",
    [pytest.param(each, marks=() if each.name == "README.md" else SLOW) for each in COMMAND_PAGES],
    ids=name_of,
)
def test_the_commands_of_a_page_run(page: Path, folder: Path, tools: Any) -> None:
    Path("my_arm.design.yaml").unlink()
    Shell(*tools).run_page(page)


@SLOW
@pytest.mark.parametrize(
    "command",
    [
        "accuracy.py --seeds 1 noise",
        "bags.py --messages 1000 --repeats 1",
        "certificate.py --runs 100 --rates 100 --scales",
        "joints.py --joints 2 --seconds 1",
        "offline.py --seconds 20 --repeats 1",
        "playing.py --seconds 1 --rates 1",
    ],
)
def test_benchmarks_end_as_they_should(command: str, folder: Path) -> None:
    script, *arguments = command.split()
    run = [sys.executable, str(ROOT / "benchmarks" / script), *arguments]
    subprocess.run(run, check=True, capture_output=True, text=True)


def prelude(page: Path) -> dict[str, Any]:
    """Return what a page's Python takes for granted."""
    design = ts.load_design()
    match page.stem:
        case "bags":
            reader = BagReader("run1")
            first = next(reader.messages(["/joint_measurements"]))
            whole = next(Path("run1").glob("*.mcap")).read_bytes()
            Path("killed").mkdir()
            Path("killed", "killed_0.mcap").write_bytes(whole[: len(whole) // 2])
            times = {"start": reader.start_time, "end": reader.end_time}
            stamps = {"log_time_ns": first.log_time, "publish_time_ns": first.publish_time}
            return {**times, **stamps, "cdr_bytes": first.data}
        case "faults":
            stamps, y, u = np.array([10**9]), np.full((1, 1), 0.1), np.zeros((1, 1))
            tracker = ts.make_tracker(design)
            return {"design": design, "tracker": tracker, "stamps": stamps, "y": y, "u": u,
                    "now": 10**9}  # fmt: skip
        case "method":
            example = import_module("tsobs_ros.paper.examples").example_1()
            return {"system": example.system, "alpha": example.alpha}
        case "recordings":
            shutil.copytree("run1", "demo/bag")
    return {}


@pytest.mark.parametrize("page", PYTHON_PAGES, ids=name_of)
def test_the_python_of_a_page_runs(page: Path, folder: Path, capsys: Any) -> None:
    names = prelude(page)
    for block in blocks(page):
        if block.language == "python":
            exec(compile(block.text, page.name, "exec"), names)
    if page.name == "README.md":
        assert np.isfinite(names["estimates"].state).all()


class LiveShell(Shell):
    """Runs the nodes of a page too; what reads their recording ends them first."""

    READY: ClassVar = {
        "observer": "certificate holds",
        "plant_simulator": "started",
        "recorder": "recording /observer/joint_states ",
    }

    def __init__(self, start: Callable[..., Any], *tools: Any) -> None:
        super().__init__(*tools)
        self._start, self._running = start, dict[str, Any]()

    def check_node(self, name: str, arguments: Sequence[str]) -> None:
        self._running[name] = self._start(name, arguments=arguments)
        self._running[name].wait_for_line(self.READY[name])
        if name == "recorder":
            self._running["observer"].wait_for_line("TRACKING")
            self._ros.spin_for(3.0)

    def run(self, command: str, error: str) -> None:
        if command.startswith("tsobs report"):
            self.end()
        super().run(command, error)

    def end(self) -> None:
        while self._running:
            _, process = self._running.popitem()
            process.signal(signal.SIGINT)
            assert process.finish().exit_code == 0


@SLOW
def test_the_tutorial_runs(
    folder: Path, ros_process: Callable[..., Any], tools: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All ten steps, with nodes that run, until the observer waits for a robot."""
    Path("my_arm.design.yaml").unlink()
    domain = str(tools[0].domain_id)
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)  # of `tsobs watch`, which runs in here
    shell = LiveShell(ros_process, *tools)

    shell.run_page(TUTORIAL)

    shell.end()
    assert BagReader("first_run").topics["/observer/joint_states"].count > 100
    assert {path.name for path in Path().glob("report.*")} >= {"report.html", "report.png"}


@SLOW
def test_the_numbers_of_a_robot_are_found(folder: Path, tools: Any) -> None:
    shutil.copy(ROOT / "examples" / "hidden_robot.py", folder)
    shell = Shell(*tools)

    shell.run_page(YOUR_ROBOT)

    fitted, robot = ts.load_request("fitted.request.yaml"), shell.robot
    assert isinstance(fitted, ts.ArmRequest)
    assert robot is not None
    for name in ("link_inertia", "motor_inertia", "stiffness", "gravity_torque", "motor_damping"):
        found = getattr(fitted.arm, name)
        assert found == pytest.approx(getattr(robot.arm, name), rel=0.02), name
    assert fitted.torque.delay == pytest.approx(robot.torque.delay, abs=5e-4)
    assert Path("fit.html").exists()
    page = YOUR_ROBOT.read_text(encoding="utf-8")
    for which, name in (("data sheet", "unfitted"), ("fitted", "robot")):
        (text,) = (
            text for ran, text in shell.printed.items() if re.match(rf"tsobs compare .*{name}", ran)
        )
        assert ("do not fit the design" in text) == (name == "unfitted")
        for shown, printed, scale in (
            ("root mean square error [mrad]", "held-out sensor +rad", 1e3),
            ("inside 3σ", "  inside 3σ", 1.0),
            ("bounds claimed", "  bounds claimed", 1.0),
        ):
            (row,) = re.findall(rf"^\| {re.escape(shown)}, {which} (.*)$", page, re.MULTILINE)
            (found,) = re.findall(rf"^{printed} (.*)$", text, re.MULTILINE)
            expected = [float(each) for each in re.findall(r"[\d.]+", row)]
            numbers = [scale * float(each) for each in re.findall(r"[\d.]+", found)]
            assert numbers == pytest.approx(expected, rel=0.05, abs=0.5), row


@pytest.mark.parametrize("target", sorted(set(re.findall(r"\]\(([^)#:]+)\)", README))))
def test_what_the_readme_points_to_exists(target: str) -> None:
    assert (ROOT / target).exists()


@pytest.mark.parametrize("line", re.findall(r"^    tsobs (\w.*?)  ", README, re.MULTILINE))
def test_the_commands_of_the_readme_exist(line: str, capsys: Any) -> None:
    word, *rest = line.split()
    for action in rest[0].split("|") if word == "bag" else [""]:
        with pytest.raises(SystemExit, match="0"):
            main([word, *filter(None, [action]), "--help"])
        usage = capsys.readouterr().out
        assert all(option in usage for option in re.findall(r"--[\w-]+", line))
