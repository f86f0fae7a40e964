"""Keys of families that are refused in one line, before anything is built."""

import pytest

from mortarbench.harness.names import parse
from mortarbench.problems import PROBLEMS
from tests.support.press import described
from tests.support.refusals import refused

REFUSED = {
    "beam-ring": [
        ("Nr=0", "Nr=0 must be at least 1"),
        ("steps=3/step=4", "step=4 must be at most steps=3"),
        ("plane=curved", "plane='curved' is unknown, expected 'strain' or 'stress'"),
        ("Nr=100000/Nh=5", "nodes; expected at most"),
        ("Nr=10/Nh=1000000000", "nodes; expected at most"),
        ("depth=-1", "depth=-1 must be at least 0"),
        ("sides=plane-strain", "sides=plane-strain is not used by depth=0"),
        ("depth=1/plane=stress", "plane=stress with depth=1 is not built"),
        ("depth=1/kinematics=finite", "kinematics=finite with depth=1 is not built"),
        ("newton=2", "newton=2 is not used by kinematics=linear"),
        ("material=svk", "material=svk is not used by"),
        ("contact_stiffness=geometric", "contact_stiffness=geometric is not used by"),
        ("kinematics=finite/relin=2", "relin=2 with kinematics=finite is not built; "
         "expected relin=1, or kinematics=linear"),
        ("kinematics=finite/plane=stress", "plane=stress with kinematics=finite is"),
        ("kinematics=finite/friction=coulomb/mu=0.3",
         "friction=coulomb with kinematics=finite is not built"),
        ("kinematics=finite/contact=mortar/contact_stiffness=geometric",
         "contact_stiffness=geometric with contact=mortar is not built; expected "
         "contact=nts"),
        ("friction=sliding", "expected 'none' or 'tresca' or 'coulomb'"),
        ("friction=tresca", "friction=tresca needs bound, a traction"),
        ("friction=coulomb", "friction=coulomb needs mu, a coefficient"),
        ("friction=coulomb/bound=1e6/mu=0.1", "bound=1e+06 is not used by"),
        ("mu=0.1", "mu=0.1 is not used by friction=none; expected no mu"),
        ("friction=tresca/bound=-5", "bound=-5; expected a traction of 0"),
        ("friction=coulomb/mu=1/loading=slow", "'quasi-static' or 'static'"),
    ],
    "cantilever": [
        ("load=0", "load=0.0 must be positive"),
        ("load=1e4", "load=10000.0 must be between 0.001 and 1000"),
        ("slenderness=1", "slenderness=1.0 must be between 2 and"),
        ("nu=0.5", "nu=0.5 must be between 0 and 0.4999"),
        ("nx=0", "nx=0 must be at least 1"),
        ("material=steel", "material='steel' is unknown, expected 'neo-hooke' or"),
        ("steps=2/step=3", "step=3 must be at most steps=2"),
        ("newton=-1", "newton=-1 must be at least 0"),
    ],
    "contact-patch": [
        ("lower=0", "lower=0 must be at least 1"),
        ("slave=both", "slave='both' is unknown, expected 'lower' or 'upper'"),
        ("basis=cubic", "basis='cubic' is unknown, expected 'dual' or 'standard'"),
        ("ratio=0", "ratio=0.0 must be positive"),
        ("distort=0.1", "distort=0.1 is not used by dim=2; expected no distort, or"),
        ("dim=3/distort=0.5", "distort=0.5 must be between 0 and 0.35"),
        ("dim=3/plane=stress", "plane=stress with dim=3 is not built; expected plane"),
        ("dim=3/kinematics=finite", "kinematics=finite with dim=3 is not built"),
        ("stretch=0.8", "stretch=0.8 is not used by"),
        ("kinematics=finite/stretch=1.2", "stretch=1.2 must be"),
        ("friction=coulomb/mu=-0.1", "mu=-0.1; expected a coefficient"),
        ("loading=static", "loading=static is not used by friction=none"),
    ],
    "cube-wall": [
        ("n=0", "n=0 must be at least 1"),
        ("glue=redundant", "glue=redundant is not used by feti=0"),
        ("n=4000", "of memory; expected a mesh that fits"),
    ],
    "greco": [
        ("n=1", "n=1 must be at least 2"),
        ("mu=-0.5", "mu=-0.5 must be between 0 and"),
        ("depth=2", "depth=2 is not used by dim=2"),
        ("parts=4", "unknown key 'parts'; known: "),
    ],
    "half-plane": [
        ("Q=0.5", "Q=0.5 is not used by law=hertz; expected no Q, or law=cattaneo"),
        ("law=cattaneo", "Q=0.0 must be between 0 and 1"),
        ("law=cattaneo/Q=1", "Q=1.0 must be between 0 and 1, a fraction of the"),
        ("law=cattaneo/Q=-0.5", "Q=-0.5 must be between 0 and 1"),
        ("n=1", "n=1 must be at least 2"),
        ("n=90000000", "a full matrix of 90000000"),
        ("law=coulomb", "law='coulomb' is unknown, expected 'hertz' or 'cattaneo'"),
    ],
    "half-space": [
        ("n=3", "n=3 must be between 4 and 8192"),
        ("law=flat", "expected 'hertz' or 'mindlin' or 'rough'"),
        ("nu=0.6", "nu=0.6 must be between 0 and 0.5"),
        ("law=mindlin/Q=1", "Q=1.0 must be between 0 and 1"),
        ("law=mindlin/mu=-1", "mu=-1.0 must be positive"),
        ("Q=0.3", "Q=0.3 is not used by law=hertz with friction=none"),
        ("seed=1", "seed=1 is not used by law=hertz"),
        ("law=mindlin/roughness=0.1", "roughness=0.1 is not used by law=mindlin"),
        ("law=mindlin/friction=coulomb", "expected no friction, or law=hertz"),
        ("law=rough/friction=tresca", "friction=tresca is not used by law=rough;"),
        ("law=rough/n=32", "n=32 must be at least 64 for law=rough"),
        ("friction=tresca", "friction=tresca needs bound, a traction"),
        ("friction=tresca/bound=1/mu=0.2", "mu=0.2 is not used"),
        ("bound=1", "bound=1.0 is not used by law=hertz with friction=none"),
        ("friction=coulomb/n=64", "expected n=48 or less, or law=mindlin"),
    ],
    "hertz-cylinder": [
        ("m=0", "m=0 must be at least 1"),
        ("ratio=0", "ratio=0.0 must be positive"),
        ("Q=0.5", "friction=none is not supported with a tangential force"),
        ("friction=tresca/bound=1e6/Q=0.5", "expected friction=coulomb, or no Q"),
        ("friction=coulomb/mu=0.3/Q=1", "Q=1.0 must be between 0 and 1, a fraction of"),
        ("friction=coulomb/mu=0/Q=0.5", "mu=0.0 must be positive"),
        ("friction=coulomb/mu=0.3/Q=0.5/ratio=2", "expected ratio=1.0, or no Q"),
    ],
    "hertz-plane": [
        ("n=0", "n=0 must be at least 1"),
        ("load=-1", "load=-1.0 must be positive"),
        ("friction=coulomb", "unknown key 'friction'"),
        ("kinematics=finite/newton=-1", "newton=-1 must be at least"),
    ],
    "hertz-sphere": [
        ("n=0", "n=0 must be at least 1"),
        ("nu=0.5", "nu=0.5 must be between -1 and 0.5"),
        ("against=spher", "against='spher' is unknown, expected 'plane' or 'sph"),
        ("contact=nts", "contact=nts is not used by against=plane; expected no contact,"
         " or aga"),
        ("basis=standard", "basis=standard is not used by against=plane"),
        ("Q=0.5", "Q=0.5 is not supported with against=plane; expected against=sphere"),
        ("against=sphere/Q=1", "Q=1.0 must be between 0 and 1, a fraction"),
        ("against=sphere/mu=0.2", "mu=0.2 is not used by Q=0; expected no mu"),
    ],
    "membranes": [
        ("S=0", "S=0 must be at least 1"),
        ("n=0", "n=0 must be at least 1"),
        ("glue=tape", "glue='tape' is unknown, expected 'orthonormal' or 'redundant'"),
    ],
    "obstacle": [
        ("dim=3", "dim=3 is unknown, expected 1 or 2"),
        ("n=1", "n=1 must be at least 2"),
        ("shape=hemisphere/dim=1", "shape=hemisphere needs dim=2"),
        ("feti=-1", "feti=-1 must be at least 0"),
        ("glue=redundant", "glue=redundant is not used by feti=0"),
        ("mu=0.3", "unknown key 'mu'"),
    ],
    "plate": [
        ("Sx=0", "Sx=0 must be at least 1"),
        ("width=-1", "width=-1.0 must be between 0 and"),
        ("jump=2", "jump=2.0 is not used by pattern=uniform"),
        ("pattern=stripes", "'uniform' or 'checkerboard' or 'column'"),
        ("Sz=2", "Sz=2 is not used by dim=2"),
    ],
    "bodies:press.toml": [
        ("parts=-1", "parts=-1 must be at least 0"),
        ("glue=redundant", "glue=redundant is not used by parts=0"),
        ("feti=4", "unknown key 'feti'; "),
    ],
    "string": [("n=2", "n=2 must be at least 3")],
    "torsion": [("twist=0", "twist=0.0 must be positive")],
    "journal-bearing": [("eccentricity=1", "eccentricity=1.0 must be below 1")],
}  # fmt: skip


@pytest.mark.parametrize(
    ("family", "keys", "message"),
    [(family, *row) for family, rows in REFUSED.items() for row in rows],
)
def test_keys_that_do_not_fit_are_refused_with_the_remedy(
    family, keys, message, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    described(tmp_path)
    known = PROBLEMS[family.partition(":")[0]]
    with refused(message):
        parse(f"{family}/{keys}/{known.forms[0]}", PROBLEMS)
