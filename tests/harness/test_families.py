"""Families: subclasses of `Family`, and wrapped objects."""

from dataclasses import dataclass

import pytest

from mortarbench.harness import Family, InputError
from mortarbench.harness.names import assemble, parse
from mortarbench.harness.plugin import as_family
from tests.support.toy_problem import Well


class Bare:
    """Family with only the required attributes."""

    name, defaults, forms = "bare", {"n": 1}, ("only",)

    def build(self, form, params, reference):
        return f"{form} {params}"


@dataclass(frozen=True)
class Doubled(Family):
    name: str = "doubled"
    forms: tuple = ("only",)
    defaults = {"n": 1, "twice": 2}  # noqa: RUF012

    def build(self, form, params, reference):
        raise AssertionError("it is only named, never run")

    def complete(self, given):
        return {"n": 1, "twice": 2 * given.get("n", 1), **given}


def test_missing_attributes_of_a_family_have_defaults():
    family = as_family(Bare())

    assert family.complete({"n": 3}) == {"n": 3}
    assert family.complete({}) == {"n": 1}
    assert family.path_suffix is None
    assert family.check({"n": -1}) is None


def test_attributes_of_a_family_and_its_docstring_are_kept():
    family = as_family(Well())

    assert isinstance(family, Family)
    assert (family.name, dict(family.defaults)) == ("well", {"n": 3, "depth": 1})
    assert (type(family).__name__, type(family).__doc__) == ("Well", Well.__doc__)
    assert as_family(Bare()).build("only", {"n": 2}, None) == "only {'n': 2}"
    with pytest.raises(InputError):
        assemble(family, {"n": 0}, family.forms[0])


def test_a_family_that_inherits_is_not_wrapped():
    family = Doubled()

    assert as_family(family) is family
    assert as_family(as_family(Bare())).name == "bare"


def test_a_case_has_its_name_parameters_and_family():
    family = Doubled()
    case = parse("doubled/n=3/only", {"doubled": family})
    finer = assemble(family, {"n": 6}, case.form)

    assert f"{case}" == case.name == "doubled/n=3/only"
    assert case.params == {"n": 3, "twice": 6}
    assert case.family is family
    assert str(finer) == "doubled/n=6/only"


def test_a_family_must_build_a_case():
    case = parse("bare/only", {"bare": as_family(Bare())})

    with pytest.raises(TypeError, match="build returned str, expected Case"):
        case.build(None)
