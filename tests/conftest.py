"""What several test files need: robots in their worlds, loaded once, random states, motions, networks, a browser."""

from __future__ import annotations

import base64
import dataclasses
import io
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import websocket
from hypothesis import settings
from PIL import Image

from ppcbf_robots.barriers import Barrier, BarrierKind
from ppcbf_robots.controllers import Gains, NominalController
from ppcbf_robots.network import NetworkKind, NumpyNetwork
from ppcbf_robots.problem import Problem, load_problem
from ppcbf_robots.robot import Dynamics, RobotModel
from ppcbf_robots.specs import Array

settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")

PAIRS = {"cartpole": "wall", "two_link": "circle", "panda": "sphere", "kinova": "five_spheres"}
BARRIERS = ["lb-cbf", "ncbf-mlp", "ncbf-convex", "pp-ncbf-mlp", "pp-ncbf-convex", "pp-cbf"]

States = Callable[..., Iterator[tuple[Array, Array]]]
AlongMotion = Callable[..., tuple[Dynamics, Dynamics]]


@pytest.fixture(scope="session", autouse=True)
def cache_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The tests share a cache of fitted bodies of their own."""
    path = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(path))
        yield path


@pytest.fixture(scope="session")
def problems(cache_folder: Path) -> dict[str, Problem]:
    """Every robot of the tests in its world, by the robot's name; kinova has continuous joints."""
    return {robot: load_problem(robot, world) for robot, world in PAIRS.items()}


@pytest.fixture(params=PAIRS)
def problem(request: pytest.FixtureRequest, problems: dict[str, Problem]) -> Problem:
    """Each problem in turn."""
    return problems[request.param]


@pytest.fixture
def cartpole(problems: dict[str, Problem]) -> Problem:
    return problems["cartpole"]


@pytest.fixture
def two_link(problems: dict[str, Problem]) -> Problem:
    return problems["two_link"]


@pytest.fixture
def panda(problems: dict[str, Problem]) -> Problem:
    return problems["panda"]


@pytest.fixture(scope="session")
def make_brisk_panda(cache_folder: Path) -> Callable[[str], Problem]:
    """The Panda in a world, with springs that leave hardly any torque beside gravity."""

    def make(world: str) -> Problem:
        problem = load_problem("panda", world)
        gains = Gains(
            "bounded_spring",
            np.array([120.0, 90.0, 110.0, 110.0, 18.0, 18.0, 8.0]),
            np.array([14.0, 11.0, 12.0, 11.0, 1.6, 1.6, 0.8]),
            np.array([60.0, 30.0, 50.0, 50.0, 8.0, 8.0, 8.0]),
        )
        controller = NominalController(problem.model, gains, problem.robot.goal)
        problem = dataclasses.replace(problem, robot=dataclasses.replace(problem.robot, controller=controller))
        return problem.with_barrier_spec(problem.robot.spec.barrier.model_copy(update={"gamma": 20.0}))

    return make


@pytest.fixture(scope="session")
def brisk_panda(make_brisk_panda: Callable[[str], Problem]) -> Problem:
    """That among five spheres."""
    return make_brisk_panda("five_spheres")


@pytest.fixture
def kinova(problems: dict[str, Problem]) -> Problem:
    return problems["kinova"]


@pytest.fixture(scope="session")
def states() -> States:
    """``states(problem, count, seed)`` yields uniform (q, v) of the domain X."""

    def draw(problem: Problem, count: int, seed: int = 0) -> Iterator[tuple[Array, Array]]:
        rng, domain = np.random.default_rng(seed), problem.robot.domain
        return zip(problem.model.from_angles(domain.sample_q(rng, count)), domain.sample_v(rng, count), strict=True)

    return draw


@pytest.fixture(scope="session")
def along_motion() -> AlongMotion:
    """``along_motion(model, q, v, a, dt)``: the evaluations dt before and after (q, v) at acceleration a.

    Their difference over 2 dt is the time derivative of any smooth function of (q, v), up to dt².
    """

    def evaluate(model: RobotModel, q: Array, v: Array, a: Array, dt: float = 1e-5) -> tuple[Dynamics, Dynamics]:
        before, after = (model.evaluate(model.integrate(q, s * v + 0.5 * s * s * a), v + s * a) for s in (-dt, dt))
        return before, after

    return evaluate


@pytest.fixture(scope="session")
def random_network() -> Callable[..., NumpyNetwork]:
    """``random_network(kind, nq, nv, seed)``: K_theta with random weights of the right shapes."""

    def build(kind: NetworkKind, nq: int, nv: int, seed: int = 0, width: int = 16, units: int = 5) -> NumpyNetwork:
        rng = np.random.default_rng(seed)
        inputs = nq + nv if kind == "mlp" else nq
        features = inputs if kind == "mlp" else 3 * nq
        heads = {"w_out": (width,)} if kind == "mlp" else {
            "Wa": (width, units), "Wb": (width, units * nv), "Wc": (width, units),
            "ba": (units,), "bb": (units * nv,), "bc": (units,)}  # fmt: skip
        layers = {"W0": (features, width), "b0": (width,), "W1": (width, width), "b1": (width,)}
        params = {name: rng.normal(0.0, 0.4, shape) for name, shape in {**layers, **heads}.items()}
        params["W0"] *= (inputs / features) ** 0.5  # as steep with the cosines and sines as without
        params |= {"in_shift": rng.normal(0.0, 0.1, inputs), "in_scale": rng.uniform(0.5, 1.5, inputs)}
        params |= {"b_out": np.array(0.3), "zero_at_rest": np.array(1.0)} if kind == "mlp" else {
            "v_scale": rng.uniform(0.5, 1.5, nv), "turns": np.arange(nq) % 3 < 2,
            "cone_a": rng.normal(), "cone_b": rng.normal(size=nv), "cone_c": rng.normal(),
            "bowl_a": rng.normal(), "bowl_b": rng.normal(size=nv), "bowl_c": rng.normal()}  # fmt: skip
        if kind == "convex" and nv > 2:  # as the learner has it
            params |= {"energy_a": rng.normal(), "energy_scale": rng.uniform(0.05, 0.2)}
        return NumpyNetwork(kind, params)

    return build


@pytest.fixture(scope="session")
def make_barrier(random_network: Callable[..., NumpyNetwork]) -> Callable[..., Barrier]:
    """``make_barrier(problem, name)`` for the names of BARRIERS: a kind, with the form of its random network."""

    def build(problem: Problem, name: str, seed: int = 0) -> Barrier:
        kind: BarrierKind = name.removesuffix("-mlp").removesuffix("-convex")  # type: ignore[assignment]
        form = name.removeprefix(f"{kind}-") if kind != name else None
        return problem.barrier(kind, random_network(form, problem.model.nq, problem.model.nv, seed) if form else None)

    return build


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """PyTorch with one thread: on a busy machine more only wait for each other."""
    import torch  # takes seconds: only where it is needed

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--hide-scrollbars",
    "--window-size=800,600", "--remote-debugging-port=0", "about:blank",
]  # fmt: skip


class Browser:
    """Headless Chromium with one tab, driven through the DevTools protocol."""

    def __init__(self, profile: Path) -> None:
        assert CHROMIUM is not None
        self.process = subprocess.Popen([CHROMIUM, f"--user-data-dir={profile}", *FLAGS], stderr=subprocess.DEVNULL)
        port_file = profile / "DevToolsActivePort"
        self.until(lambda: port_file.is_file() and port_file.read_text().count("\n") > 0)
        port = port_file.read_text().split()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list") as answer:
            tab = next(t for t in json.load(answer) if t["type"] == "page")
        self.socket = websocket.create_connection(tab["webSocketDebuggerUrl"], timeout=60, suppress_origin=True)
        self.count = 0
        self.complaints: list[str] = []
        self.requests: list[str] = []
        for domain in ("Runtime", "Log", "Network", "Page"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Result of one command; events that come first are noted."""
        self.count += 1
        self.socket.send(json.dumps({"id": self.count, "method": method, "params": params}))
        while True:
            message = json.loads(self.socket.recv())
            if message.get("id") == self.count:
                assert "error" not in message, message
                return dict(message["result"])
            self._note(message["method"], message["params"])

    def _note(self, event: str, params: dict[str, Any]) -> None:
        if event == "Runtime.exceptionThrown":
            self.complaints.append(json.dumps(params["exceptionDetails"])[:500])
        elif event == "Runtime.consoleAPICalled" and params["type"] in ("error", "assert"):
            self.complaints.append(json.dumps(params["args"])[:500])
        elif event == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.complaints.append(params["entry"]["text"])
        elif event == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])

    def open(self, url: str) -> None:
        """Load a page and wait until it says that it is ready."""
        self.complaints.clear()
        self.requests.clear()
        self.call("Page.navigate", url=url)
        self.until(lambda: self.evaluate("document.body && document.body.dataset.ready") == "yes")

    def evaluate(self, expression: str) -> Any:
        """Value of a JavaScript expression in the page."""
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def pixels(self) -> np.ndarray:
        """Screenshot, (height, width, 3) uint8."""
        data = self.call("Page.captureScreenshot", format="png")["data"]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))

    @staticmethod
    def until(condition: Callable[[], Any], limit: float = 60.0) -> None:
        """Wait for a condition."""
        end = time.monotonic() + limit
        while not condition():
            assert time.monotonic() < end, "waited in vain"
            time.sleep(0.05)

    def close(self) -> None:
        """End the browser."""
        self.call("Browser.close")
        self.process.wait(20)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """Headless Chromium."""
    if CHROMIUM is None:
        pytest.skip("no chromium, chromium-browser or google-chrome on the PATH")
    browser = Browser(tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


@pytest.fixture(params=BARRIERS)
def barrier_name(request: pytest.FixtureRequest) -> str:
    """Each barrier in turn, the learned ones with both forms of network."""
    return str(request.param)
