"""Digests: known values, and digests in a stored result folder."""

from io import BytesIO
from pathlib import Path

from mortarbench.harness.digest import hex_digest, pieces
from mortarbench.harness.files.store import digest_of, read_arrays

OLD = Path(__file__).parents[1] / "data" / "results-2026-11"


def test_a_digest_is_the_beginning_of_sha_256():
    """Test the example of FIPS 180-2, appendix B.1."""
    assert hex_digest([b"abc"]) == "ba7816bf8f01"
    assert hex_digest([b"a", b"", b"bc"], 16) == "ba7816bf8f01cfea"


def test_the_digest_of_a_file_does_not_depend_on_chunk_sizes():
    content = bytes(range(256)) * 10_000  # 2.56 MB: several pieces

    assert hex_digest(pieces(BytesIO(content)), 64) == hex_digest([content], 64)
    assert list(pieces(BytesIO())) == []


def test_stored_vectors_have_the_digests_that_they_were_stored_under():
    stored = list((OLD / "vectors").glob("*.npz"))

    assert stored
    assert [digest_of(read_arrays(path, ())) for path in stored] == [
        path.stem for path in stored
    ]
