"""A process that answers requests: one line of JSON on one pipe, some on another.

* it says ``{"event": "ready"}`` when it can be asked
* ``{"warm_up": true}``: it does what need not be timed, and says ``{"event": "warm"}``
* any other request: it says ``{"event": "start"}`` when it begins what is to be timed
  from outside, and ``{"event": "done", …}`` with its answer. One that measures says
  ``{"event": "timed"}`` when its clock has stopped, and waits for a line before it goes
  on: until then the parent looks at the CPU time of the process. One on ranks that emit
  a case says ``{"event": "emitted", …}`` before "start", and ``{"event": "measured"}``
  after "timed", before it evaluates the answer
* ``{"event": "fault", "what": …}`` in place of each: our own code failed

and ends when its requests do. Each request holds a ``nonce``, which all events of its
answer repeat. Whoever reads them takes them for foreign (`event_of`, `checked_answer`):
what shares a process with a solver, or has inherited a pipe from one, may write to it.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, fields
from math import isfinite
from typing import Any, TextIO

from mortarbench.harness.record import Measurement, finite, journal_name
from mortarbench.harness.solution import Status
from mortarbench.harness.verify.kkt import Residuals

LONGEST_REPLY = 2**22  #: bytes
MOST_ECHOED = 200  #: characters of what came, in a message
LONGEST_TEXT = 2000  #: characters that a solver's message may have
MOST_NAMED = 1000  #: values that a solver may name
LARGEST_COUNT = 2**53
MOST_TIMES = 1000  #: that something is done within one measurement


@dataclass(frozen=True)
class Events:
    """What the handler of a request calls while it measures."""

    start: Callable[[], None]  #: the clock starts
    timed: Callable[[], None]  #: it has stopped; returns when the parent has looked
    #: a stage beside the clock is done, by its name, with what is to be told of it
    reached: Callable[[str, Mapping[str, Any]], None]


Handle = Callable[[dict[str, Any], Events], dict[str, Any]]


def answer_requests(
    handle: Handle,
    warm_up: Callable[[], dict[str, Any] | None],
    request_fd: int,
    reply_fd: int,
) -> None:
    """Answer requests until there are no more.

    handle : takes a request and what to call meanwhile; returns the answer
    warm_up : returns what is to be told of it
    """
    for fd in (request_fd, reply_fd):
        os.set_inheritable(
            fd, False
        )  # programs that a solver starts have no use for it
    with os.fdopen(request_fd) as requests, os.fdopen(reply_fd, "w") as replies:
        _send(replies, event="ready")
        while line := requests.readline():
            request = json.loads(line)
            nonce = request.pop("nonce", "")
            try:
                if "warm_up" in request:
                    reply = {"event": "warm", **(warm_up() or {})}
                else:
                    answer = handle(request, _events(requests, replies, nonce))
                    reply = {"event": "done", **answer}
                sys.stdout.flush()  # what was printed belongs to this request
            except Exception as e:  # ours: handlers let nothing through that is not
                traceback.print_exc()
                what = " ".join(f"{type(e).__name__}: {e}".split())
                reply = {"event": "fault", "what": what[:LONGEST_TEXT]}
            _send(replies, nonce=nonce, **reply)


def _events(requests: TextIO, replies: TextIO, nonce: str) -> Events:
    def timed() -> None:
        _send(replies, event="timed", nonce=nonce)
        requests.readline()

    def reached(event: str, told: Mapping[str, Any]) -> None:
        _send(replies, event=event, nonce=nonce, **told)

    return Events(lambda: _send(replies, event="start", nonce=nonce), timed, reached)


def _send(replies: TextIO, **event: Any) -> None:
    replies.write(json.dumps(finite(event), allow_nan=False) + "\n")
    replies.flush()


class ForeignReplyError(Exception):
    """Something came that none of our processes says; the message tells what."""


def event_of(line: bytes, nonce: str, expected: str) -> dict[str, Any]:
    """Parse a reply: an event of that name, or "fault", with that nonce.

    Returns all of it but the nonce.

    Raises
    ------
    ForeignReplyError
        When the line is anything else.

    """
    try:
        reply = json.loads(line, parse_constant=_no_number)
    except (ValueError, RecursionError):
        raise ForeignReplyError(f"{_shown(line)} came, expected a reply") from None
    if not isinstance(reply, dict) or reply.get("event") not in (expected, "fault"):
        raise ForeignReplyError(f"{_shown(line)} came, expected {expected!r}")
    if expected != "ready" and reply.get("nonce") != nonce:
        raise ForeignReplyError(f"{_shown(line)} came, an answer to another request")
    return {k: v for k, v in reply.items() if k != "nonce"}


def _no_number(text: str) -> float:
    raise ValueError(text)


def _shown(line: bytes) -> str:
    text = repr(line[: MOST_ECHOED + 1].decode(errors="backslashreplace"))
    return text if len(line) <= MOST_ECHOED else f"{text[:MOST_ECHOED]}…"


Accepts = Callable[[Any], bool]


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and len(value) <= LONGEST_TEXT


def _is_any_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value <= LARGEST_COUNT


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < 1e300 and isfinite(value)


def _is_size(value: Any) -> bool:
    return value is None or (_is_number(value) and 0 <= value < 1e12)


def _is_time(value: Any) -> bool:
    """Any number: what the worker's clock says is held against ours."""
    return value is None or _is_number(value)


def _maybe(accepts: Accepts) -> Accepts:
    return lambda value: value is None or accepts(value)


def _named(accepts: Accepts) -> Accepts:
    def is_named(value: Any) -> bool:
        return (
            isinstance(value, dict)
            and len(value) <= MOST_NAMED
            and all(_is_text(name) and accepts(v) for name, v in value.items())
        )

    return is_named


def _is_mean_and_largest(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_size, value))


def _is_bounds(value: Any) -> bool:
    """As of `harness.verify.verdicts.certified`: they become fields of the record."""
    return _named(lambda v: _maybe(_is_number)(v) or _named(_maybe(_is_number))(v))(
        value
    ) and all(name.startswith(("energy", "certif")) for name in value)


def _is_evaluation(value: Any) -> bool:
    """As of `harness.verify.verdicts.evaluated_by_ranks`."""
    return (
        isinstance(value, dict)
        and value.keys() == _EVALUATED.keys()
        and all(accepts(value[name]) for name, accepts in _EVALUATED.items())
        and (value["values"] or _VALUES).keys() == _VALUES.keys()
    )


def _cost(field: Field[Any]) -> Accepts:
    """Tell what is accepted as what a measurement cost, by the field's name and type.

    A count is of something that happened at least once.
    """
    if str(field.type) == "int":
        return lambda value: _is_count(value) and 1 <= value <= MOST_TIMES
    return _is_time if field.name.endswith("_seconds") else _is_size


_VALUES = dict.fromkeys(("objective", *Residuals._fields))
_EVALUATED: Mapping[str, Accepts] = {
    "values": _maybe(_named(_is_number)),
    "bounds": _maybe(_is_bounds),
    "quantities": _maybe(lambda value: isinstance(value, dict)),
    "recover_seconds": _is_size,
    "notes": lambda value: isinstance(value, list) and all(map(_is_text, value)),
}
_MEASURED: Mapping[str, Accepts] = {
    "claimed": lambda value: isinstance(value, str) and value in set(Status),
    "message": _is_text,
    "iterations": _maybe(_is_count),
    "counts": _named(_is_count),
    "reported": _named(lambda v: v is None or _is_number(v) or _is_text(v)),
    "rank_seconds": _named(_is_mean_and_largest),
    "rank_counts": _named(_is_mean_and_largest),
    "rank_network": _named(_is_mean_and_largest),
    "first_seconds": _is_time,
    "canary_seconds": _is_size,
    **{journal_name(f.name): _cost(f) for f in fields(Measurement)},
}
_MEASURED_BY_RANKS = {**_MEASURED, "evaluated": _maybe(_is_evaluation)}
#: of the event "emitted"
_EMITTED: Mapping[str, Accepts] = {
    "sizes": _named(_is_count), "digest": _is_text, "build_seconds": _is_size,
}  # fmt: skip
_CHECKED: Mapping[str, Accepts] = {
    "grade": _is_text, "message": _is_any_text, "work": _maybe(_is_number),
}  # fmt: skip
_UNBUILT: Mapping[str, Accepts] = {
    "unbuilt": _is_any_text, "trace": _is_any_text,
    "past_end": lambda value: isinstance(value, bool),
}  # fmt: skip
_BUILT: Mapping[str, Accepts] = {"meta": lambda value: isinstance(value, dict)}
_DESCRIBED: Mapping[str, Accepts] = {
    "quantities": lambda value: isinstance(value, dict),
    "bounds": _is_bounds,
    "notes": lambda value: isinstance(value, list) and all(map(_is_any_text, value)),
    "seconds": _is_size,
}
_EMITS: Mapping[str, Accepts] = {"emits": lambda value: isinstance(value, bool)}
_SOLVED: Mapping[str, Accepts] = {"found": lambda value: isinstance(value, bool)}
#: what may come, by what the request asks for
_ANSWERS: Mapping[str, tuple[Mapping[str, Accepts], ...]] = {
    "qp": (_MEASURED,),
    "case": (_MEASURED_BY_RANKS,),
    "check": (_CHECKED,),
    "build": (_BUILT, _UNBUILT),
    "describe": (_DESCRIBED, _UNBUILT),
    "emits": (_EMITS,),
    "solve": (_SOLVED,),
}


def measures(request: Mapping[str, Any]) -> bool:
    """Whether a request is for a measurement, which has a clock of its own."""
    return kind_of(request) in ("qp", "case")


def kind_of(request: Mapping[str, Any]) -> str:
    """Tell what a request asks for; "" where it is none of ours."""
    kinds = [
        kind
        for kind in ("build", "describe", "emits", "solve", "check", "qp", "case")
        if kind in request
    ]
    return kinds[0] if kinds else ""


def checked_answer(request: Mapping[str, Any], answer: dict[str, Any]) -> None:
    """Compare an answer with what may come of a request.

    Raises
    ------
    ForeignReplyError
        When it has other fields, or one of another type or out of range.

    """
    _checked(_ANSWERS.get(kind_of(request), ()), answer)
    seconds = [
        answer.get(f"{phase}_seconds") for phase in ("prepare", "solve", "total")
    ]
    if measures(request) and any(s is None for s in seconds) != all(
        s is None for s in seconds
    ):
        raise ForeignReplyError("an answer came with some of its times missing")


def checked_emitted(told: dict[str, Any]) -> None:
    """Compare what ranks tell of the QP that they have emitted with what may come.

    Raises
    ------
    ForeignReplyError
        As `checked_answer`.

    """
    _checked((_EMITTED,), told)


def _checked(
    allowed: tuple[Mapping[str, Accepts], ...], answer: dict[str, Any]
) -> None:
    if not allowed:
        return
    fields = next((a for a in allowed if a.keys() == answer.keys()), None)
    if fields is None:
        missing = sorted(allowed[0].keys() ^ answer.keys())
        raise ForeignReplyError(
            f"an answer came whose fields are not ours: {', '.join(missing)}"[
                :MOST_ECHOED
            ]
        )
    for name, accepts in fields.items():
        if not accepts(answer[name]):
            got = _shown(json.dumps(answer[name]).encode())
            raise ForeignReplyError(f"an answer came with {name} = {got}")
