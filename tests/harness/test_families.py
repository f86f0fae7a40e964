"""Families: keys from annotations, derived keys, messages for bad values."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import pytest

from mortarbench.harness import DERIVED, Family, InputError, Range
from mortarbench.harness.keys import keys_of
from mortarbench.harness.names import assemble, parse


@dataclass(frozen=True, kw_only=True)
class Doubled(Family):
    forms: ClassVar = ("only",)

    n: Annotated[int, Range(1, 9), "some number"] = 1
    twice: int = DERIVED
    size: Annotated[float, Range(0)] = 1.0
    law: Literal["soft", "hard"] = "soft"

    def __post_init__(self):
        self.derive(twice=2 * self.n)
        super().__post_init__()

    def build(self, form, reference):
        return f"{form} {self.n}"


def test_keys_have_the_types_ranges_and_help_texts_of_their_annotations():
    keys = keys_of(Doubled)

    assert list(keys) == ["n", "twice", "size", "law"]
    assert (keys["n"].kind, keys["n"].default, str(keys["n"].range)) == (
        int, 1, "between 1 and 9",
    )  # fmt: skip
    assert keys["n"].help == "some number"
    assert keys["law"].choices == ("soft", "hard")
    assert keys["twice"].default is None


def test_a_derived_key_follows_other_keys_even_after_it_was_set():
    family = Doubled(n=3, twice=7)

    assert Doubled(n=3).twice == 6
    assert family.twice == 7
    assert family.with_keys(n=4).twice == 8
    assert family.params == {"n": 3, "twice": 7, "size": 1.0, "law": "soft"}


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"n": 0}, "n=0 must be between 1 and 9"),
        ({"size": -1.0}, "size=-1.0 must be at least 0"),
        ({"law": "firm"}, "law='firm' is unknown, expected 'soft' or 'hard'"),
    ],
)
def test_a_value_out_of_range_is_refused_in_one_line(keys, message):
    with pytest.raises(InputError) as direct:
        Doubled(**keys)
    with pytest.raises(InputError) as named:
        assemble("doubled", Doubled(), keys, "only")

    assert str(direct.value) == message
    assert str(named.value) == f"doubled: {message}"


def test_ranges_hold_even_if_a_family_overrides_post_init():
    @dataclass(frozen=True)
    class Careless(Doubled):
        def __post_init__(self):
            self.derive(twice=1 // self.n)

    with pytest.raises(InputError, match="careless: n=0 must be between 1 and 9"):
        assemble("careless", Careless(), {"n": 0}, "only")


def test_a_family_must_build_a_case():
    case = parse("doubled/only", {"doubled": Doubled()})

    with pytest.raises(TypeError, match="build returned str, expected Case"):
        case.build(None)
