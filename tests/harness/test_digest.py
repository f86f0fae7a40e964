"""Digests: known values."""

from io import BytesIO

from mortarbench.harness.digest import hex_digest, pieces


def test_a_digest_is_the_beginning_of_sha_256():
    """Test the example of FIPS 180-2, appendix B.1."""
    assert hex_digest([b"abc"]) == "ba7816bf8f01"
    assert hex_digest([b"a", b"", b"bc"], 16) == "ba7816bf8f01cfea"


def test_the_digest_of_a_file_does_not_depend_on_chunk_sizes():
    content = bytes(range(256)) * 10_000  # 2.56 MB: several pieces

    assert hex_digest(pieces(BytesIO(content)), 64) == hex_digest([content], 64)
    assert list(pieces(BytesIO())) == []
