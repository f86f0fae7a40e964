"""Case names: strict parsing, and canonical names."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mortarbench.harness import DERIVED, Family, Range
from mortarbench.harness.names import CaseId, assemble, parse
from tests.support.refusals import refused


@dataclass(frozen=True, kw_only=True)
class Named(Family):
    def build(self, form, reference):
        raise AssertionError("it is only named, never run")


@dataclass(frozen=True, kw_only=True)
class Ring(Named):
    """Family with derived keys, as in beam-ring."""

    forms: ClassVar = ("primal", "dual")

    Nh: Annotated[int, Range(1)] = 5
    layers: int = DERIVED
    steps: int = 10
    step: int = DERIVED
    size: float = 1.0
    plane: str = "strain"

    def __post_init__(self):
        self.derive(layers=2 * self.Nh, step=self.steps)
        super().__post_init__()


@dataclass(frozen=True, kw_only=True)
class Plain(Named):
    forms: ClassVar = ("primal",)

    n: int = 4
    kind: str = "soft"


RING, PLAIN = Ring(), Plain()
FAMILIES = {"ring": RING, "plain": PLAIN}


def test_keys_left_out_take_their_defaults_in_the_family_s_order():
    name = parse("plain/kind=hard/primal", FAMILIES)

    assert name == CaseId(
        family=Plain(kind="hard"), name="plain/kind=hard/primal", form="primal"
    )
    assert list(name.params) == ["n", "kind"]


def test_a_derived_default_follows_the_key_that_it_derives_from():
    params = parse("ring/Nh=7/steps=3/dual", FAMILIES).params

    assert (params["layers"], params["step"]) == (14, 3)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("ring/steps=10/Nh=5/dual", "ring/dual"),
        ("ring/step=2/Nh=7/dual", "ring/Nh=7/step=2/dual"),
        ("ring/layers=10/primal", "ring/primal"),
        ("ring/layers=10/Nh=7/primal", "ring/Nh=7/layers=10/primal"),
        ("ring/layers=14/Nh=7/primal", "ring/Nh=7/primal"),
        ("ring/steps=1/step=1/primal", "ring/steps=1/primal"),
        ("ring/steps=20/step=10/primal", "ring/steps=20/step=10/primal"),
        ("ring/size=1/primal", "ring/primal"),
        ("ring/size=0.5/Nh=007/primal", "ring/Nh=7/size=0.5/primal"),
        ("plain/kind=hard/n=+9/primal", "plain/n=9/kind=hard/primal"),
    ],
)
def test_a_canonical_name_lists_non_default_keys_in_the_order_of_the_family(
    text, expected
):
    name = parse(text, FAMILIES)

    assert str(name) == expected


@given(
    Nh=st.integers(1, 9),
    layers=st.integers(1, 18),
    steps=st.integers(1, 12),
    step=st.integers(1, 12),
    size=st.floats(allow_nan=False, allow_infinity=False),
    form=st.sampled_from(RING.forms),
)
def test_a_canonical_name_parses_to_the_case_that_it_names(form, **params):
    name = assemble("ring", RING, params, form)

    assert parse(str(name), FAMILIES) == name


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rung/dual", "unknown family 'rung'; did you mean 'ring'? known: plain, ring"),
        ("ring/Nhh=3/dual", "ring: unknown key 'Nhh'; did you mean 'Nh'? known: "),
        ("ring/Nh=3/Nh=4/dual", "ring: key 'Nh' is set twice; set it once"),
        ("ring/Nh3/dual", "ring: malformed component 'Nh3'; expected key=value"),
        ("ring/Nh=x/dual", "ring: Nh='x'; expected an integer, such as 4"),
        (
            f"ring/Nh={20 * '9'}/dual",
            "ring: Nh=99999999999999999999; expected an integer of at most 64 bits",
        ),
        ("an/dual", "unknown family 'an'; known: plain, ring"),
        (
            "ring/size=wide/dual",
            "ring: size='wide'; expected a finite number, such as 0.5",
        ),
        (
            "ring/plane=/dual",
            "ring: plane=''; expected nonempty text without control characters, / "
            "and =",
        ),
        ("ring/Nh=0/dual", "ring: Nh=0 must be at least 1"),
        ("ring/duel", "ring: unknown form 'duel'; did you mean 'dual'?"),
        ("ring/Nh=3", "ring/Nh=3: no form at the end; expected one of primal, dual"),
        ("ring", "ring: no form at the end; expected one of primal, dual"),
        ("", "unknown family ''"),
    ],
)
def test_an_invalid_name_is_reported_in_one_line(text, message):
    with refused(start=message):
        parse(text, FAMILIES)
