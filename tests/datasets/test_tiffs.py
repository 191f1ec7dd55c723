"""Laws of TIFFs: pixels of any kind, byte order, compression and orientation are read as stored, or refused by name."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest

from phydict.datasets.radiographs.xray_images import read_image

FORMATS = {"u": 1, "i": 2, "f": 3}


def write_tiff(path, pixels, squeezed=False, orientation=1):
    """Pixels in their own byte order, squeezed or not, with a tag that says how they are to be turned."""
    mark = ">" if pixels.dtype.byteorder == ">" else "<"
    data = zlib.compress(pixels.tobytes()) if squeezed else pixels.tobytes()
    rows, columns = pixels.shape
    shorts = {256: columns, 257: rows, 258: 8 * pixels.itemsize, 259: 8 if squeezed else 1, 262: 1, 274: orientation,
              277: 1, 278: rows, 339: FORMATS[pixels.dtype.kind]}
    longs = {273: 8, 279: len(data)}
    tags = [(tag, struct.pack(f"{mark}HHIHH", tag, 3, 1, value, 0)) for tag, value in shorts.items()]
    tags += [(tag, struct.pack(f"{mark}HHII", tag, 4, 1, value)) for tag, value in longs.items()]
    head = struct.pack(f"{mark}2sHI", b"II" if mark == "<" else b"MM", 42, 8 + len(data))
    path.write_bytes(head + data + struct.pack(f"{mark}H", len(tags)) + b"".join(raw for _, raw in sorted(tags))
                     + bytes(4))
    return path


def stored(kind):
    return (np.arange(6 * 9).reshape(6, 9) * 3 + 1).astype(kind)


@pytest.mark.parametrize("kind", ["u1", "<u2", ">u2", "<i2", "<f4"])
@pytest.mark.parametrize("squeezed", [False, True])
@pytest.mark.parametrize("orientation, turned", [
    (1, lambda a: a), (2, np.fliplr), (3, lambda a: a[::-1, ::-1]), (4, np.flipud), (5, np.transpose),
    (6, lambda a: np.rot90(a, -1)), (7, lambda a: a[::-1, ::-1].T), (8, np.rot90)])
def test_an_image_is_turned_as_its_tag_says_whatever_its_pixels(tmp_path, kind, squeezed, orientation, turned):
    read = read_image(write_tiff(tmp_path / "view.tif", stored(kind), squeezed, orientation))
    np.testing.assert_array_equal(read, turned(stored(kind)))


@pytest.mark.parametrize("squeezed", [False, True])
@pytest.mark.parametrize("kind", ["u1", "<u2", ">u2", "<i2", ">i2", "<i4", ">i4", "<u4", "<f4", ">f4"])
def test_pixels_are_read_as_stored_or_refused_by_their_byte_order(tmp_path, kind, squeezed):
    pixels = stored(kind)
    if pixels.itemsize > 2:
        pixels[0, 0] = np.iinfo(kind).max if pixels.dtype.kind in "iu" else 1e20
    path = write_tiff(tmp_path / "view.tif", pixels, squeezed)
    if squeezed and kind[0] == ">" and kind != ">u2":
        with pytest.raises(ValueError, match="view.tif cannot be read .*big-endian.*store it as little-endian"):
            read_image(path)
    else:
        np.testing.assert_array_equal(read_image(path), pixels)


@pytest.mark.parametrize("kind", ["<f8", "<f2", ">u4", "<u8"])
def test_pixels_of_kinds_that_are_not_read_are_refused_with_those_that_are(tmp_path, kind):
    with pytest.raises(ValueError, match="view.tif cannot be read .*TIFF .*32-bit floating-point.*; export it again"):
        read_image(write_tiff(tmp_path / "view.tif", stored(kind)))
