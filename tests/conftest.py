"""Shared by all tests: CPUs of pytest's workers, QPs of known solution."""

import gc
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib import import_module

import pytest
from xdist.remote import Producer
from xdist.scheduler import LoadScopeScheduling
from xdist.workermanage import WorkerController

from mortarbench.harness import QP, Solution
from mortarbench.harness.conformance.manufactured import manufactured as drawn
from mortarbench.harness.limits import ONE_THREAD
from mortarbench.harness.processes import supervisor
from tests.support import ROOT
from tests.support.fork_server import Forks


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Run two tests per CPU where CPUs are few: a third of the time, tests wait."""
    cpus = len(os.sched_getaffinity(0))
    return max(cpus, min(2 * cpus, 8))


class OneProcessPerModule(LoadScopeScheduling):
    """Tests of a module marked `together` run in one process, others anywhere."""

    def _split_scope(self, nodeid: str) -> str:
        module = nodeid.partition("::")[0]
        return module if shares(module) else nodeid

    def mark_test_complete(
        self, node: WorkerController, item_index: int, duration: float = 0
    ) -> None:
        """Forget a unit that is done: after each test, those pending are counted."""
        super().mark_test_complete(node, item_index, duration)
        units = self.assigned_work[node]
        scope = self._split_scope(self.registered_collections[node][item_index])
        if all(units[scope].values()):
            del units[scope]


@cache
def shares(module: str) -> bool:
    """Whether a module of tests, by its path from the root, is marked `together`."""
    return "pytestmark = pytest.mark.together" in (ROOT / module).read_text("utf-8")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(
    config: pytest.Config, log: Producer
) -> OneProcessPerModule:
    """Group by modules; groups by marks need names of tests to change in collection."""
    return OneProcessPerModule(config, log)


def pytest_configure(config: pytest.Config) -> None:
    """Share the CPUs among pytest-xdist's workers.

    The harness binds what it measures to the last CPU that it may use; without this,
    all workers would measure on the same one.
    """
    os.environ.update(ONE_THREAD)  # as the command line does
    os.environ["MPIR_CVAR_ENABLE_HEAVY_YIELD"] = "1"  # ranks of MPICH wait asleep
    worker = getattr(config, "workerinput", None)
    if worker is not None:
        cpus = sorted(os.sched_getaffinity(0))
        index = int(worker["workerid"].removeprefix("gw")) % len(cpus)
        os.sched_setaffinity(0, cpus[index :: worker["workercount"]])


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Iterator[None]:
    """Look for no garbage while modules are imported: what that makes lives on."""
    gc.disable()
    try:
        import_share(session.config)
        return (yield)
    finally:
        gc.enable()


def import_share(config: pytest.Config) -> None:
    """Import a worker's share of all modules of tests, before it imports the others.

    Their asserts are rewritten, which takes ten times as long as importing what was
    rewritten before: of a fresh checkout, each worker would rewrite them all.
    """
    worker = getattr(config, "workerinput", None)
    if worker is None or config.args_source is not pytest.Config.ArgsSource.TESTPATHS:
        return
    index, count = int(worker["workerid"].removeprefix("gw")), worker["workercount"]
    for path in sorted((ROOT / "tests").rglob("test_*.py"))[index::count]:
        # what cannot be imported is told when it is collected
        with suppress(Exception, pytest.skip.Exception):
            import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))


def pytest_collection_finish() -> None:
    """Keep tests and libraries out of the collections before every measurement."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)  # those of tests leave little garbage


def pytest_unconfigure() -> None:
    """Let the end of the process free what is left: some libraries look at that."""
    gc.unfreeze()


@pytest.fixture(scope="session")
def forks():
    """What forks the processes of runs from interpreters that have loaded modules."""
    forks = Forks()
    yield forks
    forks.close()


@pytest.fixture(scope="module", autouse=True)
def how_processes_start(forks):
    """Runs in this process start theirs as forks, see `tests.support.fork_server`.

    Where how they start is tested, a fixture of this name lets them start as they do.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(supervisor, "subprocess", forks)
        yield


@pytest.fixture
def manufactured() -> Callable[..., tuple[QP, Solution]]:
    """Factory: ``manufactured(shape, seed=…, dense=False, n=20)``, as in `harness`."""
    return drawn


@pytest.fixture(scope="module")
def svg_only():
    """Factory: a context in which reports have their figures as SVG alone.

    That is what pages show; `reports/test_convergence.py` and
    `reports/figures/test_pictures.py` have all formats.
    """

    @contextmanager
    def context():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("mortarbench.reports.render.saving.ENDINGS", (".svg",))
            yield

    return context


@pytest.fixture
def only_svg(svg_only):
    """Reports of this test have their figures as SVG alone."""
    with svg_only():
        yield
