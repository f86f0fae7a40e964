"""Family `bodies`, bodies from mesh files; see `problems.models.gmsh_bodies`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from mortarbench.harness import InputError
from mortarbench.harness.checked import located
from mortarbench.harness.files.datafile import content_digest
from mortarbench.problems.families.declared import ContactFamily
from mortarbench.problems.files.file_digest import check_digest
from mortarbench.problems.ranges import (
    CONTACT_FORMS,
    FRICTION,
    GLUES,
    HALVINGS,
    KINEMATICS,
    LAW_KEYS,
    SETTINGS,
    check_decomposition,
    check_friction,
    check_kinematics,
    key,
    schema,
)

if TYPE_CHECKING:
    from mortarbench.harness import Case, Reference, Value


class GmshBodies(ContactFamily):
    """User-defined bodies: a mesh file, and a TOML file with materials and contacts.

    The digest of both files is a parameter of the case, so that changed files define a
    different case.
    """

    name = "bodies"
    path_suffix = ".toml"
    keys = schema(
        path=key(""),
        sha256=key(""),
        **SETTINGS,
        step=key(0, 1),
        iterate=FRICTION["iterate"],
        newton=KINEMATICS["newton"],
        parts=key(0, 0),
        **GLUES,
        halvings=HALVINGS,
    )
    forms = CONTACT_FORMS
    problem = "gmsh_bodies.problem"
    model = "gmsh_bodies.newton_step"
    conditions = MappingProxyType({"kinematics": check_kinematics})

    def complete(self, given: Mapping[str, Value]) -> Mapping[str, Value]:
        """Return all keys, some from the TOML file; `step` defaults to `steps`."""
        params: dict[str, Value] = {**self.defaults, **given}
        if params["path"]:
            from mortarbench.problems.models.description import read_description

            path = Path(str(params["path"]))
            table = read_description(path)
            params = {
                **params,
                **{k: table[k] for k in SETTINGS if k in table},
                **given,
            }
            if "sha256" not in given:
                params["sha256"] = content_digest(path, path.parent / table["mesh"])
        return params if "step" in given else params | {"step": params["steps"]}

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless the keys are in range and the digest is correct."""
        from mortarbench.problems.models.description import pair_laws, read_description

        p: Any = params
        if not p["path"]:
            raise InputError(f"{self.name}: path is missing; expected bodies:PATH.toml")
        super().check(params)
        meaning = "the number of subdomains"
        check_decomposition(self.name, params, key="parts", what=meaning)
        path = Path(p["path"])
        table = read_description(path)
        has_own = any(key in entry for entry in table["contacts"] for key in LAW_KEYS)
        check_friction(self.name, p, elsewhere=has_own)
        with located(str(path)):
            pair_laws(table["contacts"], params)
        mesh = path.parent / table["mesh"]
        check_digest(p["path"], p["sha256"], content_digest(path, mesh))

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Return the case of one load step in the form `form`.

        Raises
        ------
        InputError
            If a file is invalid, or if the Cholesky factorisation fails because of
            rounding.

        """
        from numpy.linalg import LinAlgError
        from sksparse.cholmod import CholmodNotPositiveDefiniteError

        from mortarbench.problems.models.description import remarks
        from mortarbench.problems.models.gmsh_bodies import (
            contact_remarks,
            mesh_remarks,
        )

        path = str(params["path"])
        try:
            case = super().build(form, params, reference)
        except (LinAlgError, CholmodNotPositiveDefiniteError):
            raise InputError(
                f"{path}: the stiffness has no Cholesky factor in double precision; "
                "expected smaller ratios between the sides of cells and between the "
                "moduli E"
            ) from None
        notes = (*remarks(Path(path)), *mesh_remarks(params), *contact_remarks(params))
        return replace(case, remarks=notes)
