"""What tells one file's contents from another's."""

import zlib
from pathlib import Path


def file_crc32(path: Path, start: int = 0) -> int:
    """CRC-32 of a file's bytes, going on from the checksum `start`; read in pieces, so that any size fits in memory."""
    crc = start
    with path.open("rb") as file:
        while piece := file.read(2**24):
            crc = zlib.crc32(piece, crc)
    return crc
