"""Messages of the executor about a case worker that ends without a reply."""

import pytest

from mortarbench.harness import Verdict
from mortarbench.harness.processes.supervisor import Reply
from mortarbench.harness.results.work_unit import Commands
from mortarbench.harness.running.executor import Executor, _BuildError
from tests.support.box_records import box_record


class DeadCaseWorker:
    """Case worker that crashes on every request."""

    def ask(self, request, **limits):
        return Reply(verdict=Verdict.CRASHED, message="SIGSEGV")


@pytest.mark.parametrize(
    ("request_key", "message"),
    [
        ("build", "box/n=2/dual could not be built: SIGSEGV"),
        ("describe", "box/n=2/dual could not be evaluated: SIGSEGV"),
    ],
)
def test_the_message_names_the_case_and_the_request(tmp_path, request_key, message):
    executor = Executor(Commands(solvers={}, case_worker=[]), tmp_path, tmp_path)
    executor._case_worker = DeadCaseWorker()
    case = box_record("smalbe", 2).case

    with pytest.raises(_BuildError) as error:
        executor._ask_case_worker({request_key: {"name": case}})
    assert error.value.reason == message
