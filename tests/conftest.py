"""Shared fixtures, and hooks for CPUs and scheduling of pytest's workers."""

import gc
import os
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache
from importlib import import_module

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from xdist.remote import Producer
from xdist.scheduler import LoadScopeScheduling
from xdist.workermanage import WorkerController

from mortarbench.harness import QP, Solution
from mortarbench.harness.conformance.manufactured import manufactured as drawn
from mortarbench.harness.limits import ONE_THREAD
from mortarbench.harness.processes import supervisor
from tests.support import ROOT
from tests.support.fork_server import Forks

# Examples depend on the test alone. On a loaded machine, they may take longer than the
# limits of hypothesis.
settings.register_profile(
    "reproducible", derandomize=True, deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)  # fmt: skip
settings.load_profile("reproducible")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Use at most two workers per CPU and eight in all, but at least one per CPU."""
    cpus = len(os.sched_getaffinity(0))
    return max(cpus, min(2 * cpus, 8))


class OneProcessPerModule(LoadScopeScheduling):
    """Scheduler that runs all tests of a module marked `together` in one process."""

    def _split_scope(self, nodeid: str) -> str:
        module = nodeid.partition("::")[0]
        return module if shares(module) else nodeid

    def mark_test_complete(
        self, node: WorkerController, item_index: int, duration: float = 0
    ) -> None:
        """Drop a finished unit, since xdist counts all units after each test."""
        super().mark_test_complete(node, item_index, duration)
        units = self.assigned_work[node]
        scope = self._split_scope(self.registered_collections[node][item_index])
        if all(units[scope].values()):
            del units[scope]


@cache
def shares(module: str) -> bool:
    """Return True if a test module (path from the root) is marked `together`."""
    return "pytestmark = pytest.mark.together" in (ROOT / module).read_text("utf-8")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(
    config: pytest.Config, log: Producer
) -> OneProcessPerModule:
    """Group tests by modules; xdist's group marks would change the names of tests."""
    return OneProcessPerModule(config, log)


def pytest_configure(config: pytest.Config) -> None:
    """Share the CPUs among pytest-xdist's workers.

    The harness binds measured processes to the fastest CPU that it may use. Without
    separate CPUs, all workers would measure on the same CPU.
    """
    os.environ.update(ONE_THREAD)  # as the command line does
    os.environ["MPIR_CVAR_ENABLE_HEAVY_YIELD"] = (
        "1"  # ranks of MPICH sleep while waiting
    )
    worker = getattr(config, "workerinput", None)
    if worker is not None:
        cpus = sorted(os.sched_getaffinity(0))
        index = int(worker["workerid"].removeprefix("gw")) % len(cpus)
        os.sched_setaffinity(0, cpus[index :: worker["workercount"]])


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Iterator[None]:
    """Disable garbage collection during imports, which create little garbage."""
    gc.disable()
    try:
        import_share(session.config)
        return (yield)
    finally:
        gc.enable()


def import_share(config: pytest.Config) -> None:
    """Import a worker's share of the test modules before the worker imports the rest.

    pytest rewrites the asserts of a module and caches the result; rewriting takes ten
    times as long as loading from the cache. Otherwise, in a fresh checkout, each worker
    would rewrite all modules.
    """
    worker = getattr(config, "workerinput", None)
    if worker is None or config.args_source is not pytest.Config.ArgsSource.TESTPATHS:
        return
    index, count = int(worker["workerid"].removeprefix("gw")), worker["workercount"]
    for path in sorted((ROOT / "tests").rglob("test_*.py"))[index::count]:
        # pytest reports a failing import when it collects the module
        with suppress(Exception, pytest.skip.Exception):
            import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))


def pytest_collection_finish() -> None:
    """Exclude loaded objects from garbage collections, which precede measurements."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)  # tests create little garbage


def pytest_unconfigure() -> None:
    """Undo `gc.freeze`, since some libraries check their objects at process end."""
    gc.unfreeze()


@pytest.fixture(scope="session")
def forks():
    """Yield a fork server that starts the processes of runs with modules loaded."""
    forks = Forks()
    yield forks
    forks.close()


@pytest.fixture(scope="module", autouse=True)
def how_processes_start(forks):
    """Start the processes of runs as forks, see `tests.support.fork_server`.

    A module that tests how processes start overrides this fixture.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(supervisor, "subprocess", forks)
        yield


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """Return a generator of random numbers, seeded by the test's name and parameters.

    The numbers therefore depend neither on other tests nor on the machine.
    """
    return np.random.default_rng(zlib.crc32(request.node.name.encode()))


@pytest.fixture
def manufactured() -> Callable[..., tuple[QP, Solution]]:
    """Return the factory ``manufactured(shape, seed=…, dense=False, n=20)``."""
    return drawn


@pytest.fixture(scope="module")
def svg_only():
    """Return a context manager in which reports write figures as SVG only.

    Pages contain the SVG figures. All formats are tested in
    `reports/paper/test_paper.py` and `reports/figures/test_pictures.py`.
    """

    @contextmanager
    def context():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("mortarbench.reports.writing.ENDINGS", (".svg",))
            yield

    return context


@pytest.fixture
def only_svg(svg_only):
    """Write the figures of reports as SVG only."""
    with svg_only():
        yield


@pytest.fixture(scope="module")
def blank():
    """Return a context manager in which the figures of reports are drawn empty.

    For tests of tables and text: all files of figures are written, without content.
    """

    @contextmanager
    def context():
        from matplotlib.figure import Figure  # slow; few processes need it

        from mortarbench.reports.writing import draw_files

        def draw_blank(picture, folder):
            return draw_files(replace(picture, draw=lambda: Figure((1, 1))), folder)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("mortarbench.reports.writing.draw_files", draw_blank)
            yield

    return context


@pytest.fixture
def blank_figures(blank):
    """Draw the figures of reports empty."""
    with blank():
        yield


@pytest.fixture
def command(capsys, monkeypatch, tmp_path):
    """Return a function that runs a command line in the folder of the test.

    It takes the words of the command, and perhaps registries that replace those of the
    product, and returns the exit code, stdout and stderr. The machine appears idle.
    """
    from mortarbench.cli.main import main  # slow; few processes need it
    from mortarbench.registries import Registries

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "getloadavg", lambda: (0.1, 0.1, 0.1))

    def command(*words, registries=None):
        code = main(registries or Registries(), [*map(str, words)])
        return code, *capsys.readouterr()

    return command
