import subprocess
import sys

import numpy as np
import pytest

from mortarbench.harness import Fields, InputError, Solution, Status
from mortarbench.harness.files.store import (
    field_arrays,
    load_fields,
    load_solution,
    save,
)
from tests.support.stored import save_solution


@pytest.fixture
def solution():
    return Solution(
        status=Status.SOLVED, x=np.array([1.0, np.nan]), y=np.zeros(0),
        z=np.array([-0.0]), z_box=np.array([np.inf, 2.0]),
    )  # fmt: skip


@pytest.fixture
def fields():
    return Fields(
        points=np.eye(4, 2), cells=np.arange(4)[None], bodies=np.array([1]),
        displacement=np.ones((4, 2)), nodal={"von_mises": np.arange(4.0)},
    )  # fmt: skip


def moved(solution, **changes):
    parts = {name: getattr(solution, name) for name in ("x", "y", "z", "z_box")}
    return Solution(status=Status.SOLVED, **(parts | changes))


def test_a_point_comes_back_bit_for_bit(tmp_path, solution):
    digest = save_solution(tmp_path, solution)
    loaded = load_solution(tmp_path, digest, Status.ITERATION_LIMIT)

    assert loaded.status is Status.ITERATION_LIMIT
    for name in ("x", "y", "z", "z_box"):
        assert getattr(loaded, name).tobytes() == getattr(solution, name).tobytes()


def test_no_view_of_an_archive_outlives_a_failed_write(tmp_path):
    """If a garbage collector finds an archive and its view in one cycle, Python 3.13
    reports a BufferError, in whatever code runs at this time; earlier versions report
    it in development mode only.
    """
    program = """
import gc, sys
from pathlib import Path
import numpy as np
from mortarbench.harness.files import store
errors = []
def fail(*_):
    raise OSError(28, "No space left on device")
store.replace_file = fail
try:
    store.save(Path(sys.argv[1]), {"x": np.ones(3)})
except OSError as e:
    errors += [e, errors]
del errors
gc.collect()
"""
    done = subprocess.run(
        [sys.executable, "-X", "dev", "-c", program, tmp_path],
        capture_output=True, text=True, check=True,
    )  # fmt: skip

    assert done.stderr == ""


def test_every_vector_its_name_and_its_shape_are_part_of_the_digest(tmp_path, solution):
    variants = [
        solution,
        moved(solution, x=np.array([1.0, 2.0])),
        moved(solution, z=np.array([0.0])),
        moved(solution, x=solution.z_box, z_box=solution.x),
        moved(solution, x=np.array([[1.0], [np.nan]])),
        moved(solution, z=np.array([0])),  # same bytes as 0.0
    ]

    assert len({save_solution(tmp_path, s) for s in variants}) == len(variants)


def test_a_deformed_state_comes_back_with_its_nodal_fields(tmp_path, fields):
    loaded = load_fields(tmp_path, save(tmp_path, field_arrays(fields)))

    assert loaded.contact_nodes is None
    assert loaded.cells.dtype == fields.cells.dtype
    assert loaded.nodal.keys() == {"von_mises"}
    np.testing.assert_array_equal(loaded.nodal["von_mises"], np.arange(4.0))
    np.testing.assert_array_equal(loaded.displacement, fields.displacement)


def test_contact_forces_are_restored_if_present(tmp_path, fields):
    with_contact = Fields(
        points=fields.points, cells=fields.cells, bodies=fields.bodies,
        displacement=fields.displacement, contact_nodes=np.array([3]),
        contact_forces=np.array([[0.0, -5.0]]),
    )  # fmt: skip
    loaded = load_fields(tmp_path, save(tmp_path, field_arrays(with_contact)))

    np.testing.assert_array_equal(loaded.contact_nodes, [3])
    np.testing.assert_array_equal(loaded.contact_forces, [[0.0, -5.0]])


def test_a_missing_or_damaged_file_is_named(tmp_path, solution):
    digest = save_solution(tmp_path, solution)
    file = tmp_path / "vectors" / f"{digest}.npz"
    file.write_bytes(file.read_bytes()[:100])

    with pytest.raises(InputError, match=digest):
        load_solution(tmp_path, digest, Status.SOLVED)
    with pytest.raises(InputError, match="0000"):
        load_solution(tmp_path, "0000", Status.SOLVED)
