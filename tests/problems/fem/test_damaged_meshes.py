"""Randomly damaged mesh files of every format: each is read or refused in one line."""

import meshio
import numpy as np
import pytest

from mortarbench.harness import InputError
from mortarbench.harness.names import parse
from mortarbench.problems import PROBLEMS
from mortarbench.solvers.reference.solve import reference_solution
from tests.support.bounded import bounded
from tests.support.damaged_files import damaged
from tests.support.gmsh_files import entities41, entities_of, stacked_blocks
from tests.support.mesh_formats import INSTANCES, named_cells, write_inp, write_med
from tests.support.solid_blocks import solid_blocks


def tokens(rng, data):
    """Exchange, repeat or delete words and lines."""
    lines = data.split(b"\n")
    for _ in range(rng.integers(1, 4)):
        i, j = rng.integers(0, len(lines), 2)
        kind = rng.integers(0, 4)
        if kind == 0:
            lines[i], lines[j] = lines[j], lines[i]
        elif kind == 1:
            lines.insert(i, lines[j])
        elif kind == 2:
            del lines[i]
        else:
            words, others = lines[i].split(b" "), lines[j].split(b" ")
            words[rng.integers(0, len(words))] = others[rng.integers(0, len(others))]
            lines[i] = b" ".join(words)
        lines = lines or [b""]
    return b"\n".join(lines)


def seeds(folder):
    """Return (description, name of the mesh, intact content) of each format."""
    flat, solid = folder / "flat", folder / "solid"
    for place in (flat, solid):
        place.mkdir()
    stacked_blocks(flat)
    solid_blocks(solid, divisions=((1, 1, 1), (1, 1, 1)))
    found = []
    for place in (flat, solid):
        source = place / "blocks.msh"
        toml = (place / "blocks.toml").read_text()
        found.append((toml, "a.msh", source.read_bytes()))
        meshio.gmsh.write(place / "b.msh", meshio.gmsh.read(source), "2.2", binary=True)
        found.append((toml, "a.msh", (place / "b.msh").read_bytes()))
        points, blocks, sets = named_cells(source)
        for binary in (False, True):
            content = entities41(points, entities_of(blocks, sets), binary)
            found.append((toml, "a.msh", content))
        for write, name in ((write_inp, "a.inp"), (write_med, "a.med")):
            types = {"types": {"quad": "CPS4", "line": "T2D2", "vertex": "MASS"}}
            flat_inp = types if place == flat and name == "a.inp" else {}
            write(source, place / name, **flat_inp)
            found.append((toml, name, (place / name).read_bytes()))
    found.append((found[0][0], "a.inp", INSTANCES.encode()))
    return found


def attempt(folder, toml, name, data):
    """Return True if the bodies are read and their dual is assembled."""
    (folder / name).write_bytes(data)
    (folder / "a.toml").write_text(toml.replace("blocks.msh", name))
    try:
        with bounded(60), np.errstate(all="ignore"):
            case = parse(f"bodies:{folder}/a.toml/dual", PROBLEMS)
            case.build(reference_solution)
    except InputError as e:
        message = str(e)
    else:
        return True
    assert "\n" not in message
    assert len(message) < 1000
    return False


def fuzz(folder, count, seed):
    """Damage each format `count` times; return the number of files that are read."""
    rng, read = np.random.default_rng(seed), 0
    for toml, name, whole in seeds(folder):
        assert attempt(folder, toml, name, whole)
        for k in range(count):
            is_text = not whole.count(b"\0")
            data = (
                tokens(rng, whole)
                if k % 2 and is_text
                else damaged(rng, whole, [whole])
            )
            read += attempt(folder, toml, name, data)
    return read


def test_damaged_meshes_are_read_or_refused_in_one_line(tmp_path):
    fuzz(tmp_path, 2, 3)


@pytest.mark.slow
def test_none_of_2800_damaged_meshes_causes_a_traceback_or_hang(tmp_path):
    assert 0 < fuzz(tmp_path, 216, 4) < 2800
