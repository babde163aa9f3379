"""Whatever a file holds comes out as RGB bytes, or as one line that says why not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from analysis.wsp import image as module
from analysis.wsp.image import ImageError, dpi_of, sheets_of

YELLOW = (226, 210, 92)


@pytest.fixture
def picture() -> Image.Image:
    return Image.new("RGB", (40, 20), YELLOW)


def only(path: Path) -> module.Sheet:
    (sheet,) = sheets_of(path)
    return sheet


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.bmp", "a.jpg", "a.webp"])
def test_usual_formats_come_out_as_they_are(
    tmp_path: Path, picture: Image.Image, name: str
) -> None:
    options: dict[str, Any] = {"lossless": True} if name.endswith("webp") else {}
    picture.save(tmp_path / name, **options)
    sheet = only(tmp_path / name)
    assert sheet.pixels.shape == (20, 40, 3)
    np.testing.assert_allclose(sheet.pixels[5, 5].astype(int), YELLOW, atol=2)


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.jpg"])
def test_the_resolution_is_the_files(tmp_path: Path, picture: Image.Image, name: str) -> None:
    picture.save(tmp_path / name, dpi=(600, 600))
    assert only(tmp_path / name).dpi == pytest.approx(600.0)


@pytest.mark.parametrize(
    "stated", [(72, 72), (96.0, 96.0), (600, 300), (0, 0), (float("nan"),) * 2, ("a", "b"), (1,)]
)
def test_a_resolution_that_is_none_is_not_believed(stated: object) -> None:
    dpi, why = dpi_of({"dpi": stated})
    assert dpi is None
    assert "not used" in why


def test_cmyk_grey_palette_and_one_bit_become_colours(tmp_path: Path) -> None:
    for mode, value in (("CMYK", (0, 0, 255, 0)), ("L", 180), ("P", 3), ("1", 1)):
        path = tmp_path / f"{mode}.tif"
        Image.new(mode, (6, 5), value).save(path)
        assert only(path).pixels.shape == (5, 6, 3)
    cmyk = only(tmp_path / "CMYK.tif")
    assert any("CMYK" in note for note in cmyk.notes)
    assert cmyk.pixels[0, 0, 2] < 50 < cmyk.pixels[0, 0, 0]


def test_sixteen_bits_of_grey_become_eight(tmp_path: Path) -> None:
    grey = np.full((5, 6), 180 * 256 + 17, dtype=np.uint16)
    Image.fromarray(grey).save(tmp_path / "deep.png")
    sheet = only(tmp_path / "deep.png")
    assert (sheet.pixels == 180).all()
    assert "8 bits" in sheet.notes[0]


def test_transparent_pixels_are_white_and_not_what_hides_there(tmp_path: Path) -> None:
    Image.new("RGBA", (6, 5), (0, 0, 255, 0)).save(tmp_path / "clear.png")
    sheet = only(tmp_path / "clear.png")
    assert (sheet.pixels == 255).all()
    assert "transparent" in sheet.notes[0]


def test_each_page_is_a_sheet(tmp_path: Path, picture: Image.Image) -> None:
    other = Image.new("RGB", (30, 10), (0, 0, 0))
    picture.save(tmp_path / "two.tif", save_all=True, append_images=[other], dpi=(600, 600))
    first, second = sheets_of(tmp_path / "two.tif")
    assert (first.pixels.shape, second.pixels.shape) == ((20, 40, 3), (10, 30, 3))
    assert second.name == "two.tif page 2"


def test_a_turned_picture_is_turned_upright(tmp_path: Path, picture: Image.Image) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    picture.save(tmp_path / "turned.jpg", exif=exif)
    assert only(tmp_path / "turned.jpg").pixels.shape == (40, 20, 3)


def test_too_many_pixels_or_pages_are_refused_before_they_are_read(
    tmp_path: Path, picture: Image.Image, monkeypatch: pytest.MonkeyPatch
) -> None:
    picture.save(tmp_path / "a.tif", save_all=True, append_images=[picture] * 2)
    monkeypatch.setattr(module, "MAX_PAGES", 2)
    with pytest.raises(ImageError, match="3 pages"):
        only(tmp_path / "a.tif")
    monkeypatch.setattr(module, "MAX_PAGES", 3)
    monkeypatch.setattr(module, "MAX_PIXELS", 799)
    with pytest.raises(ImageError, match="40 x 20 pixels are too many"):
        only(tmp_path / "a.tif")


def test_a_bomb_is_refused(tmp_path: Path) -> None:
    Image.new("1", (14_000, 14_000)).save(tmp_path / "bomb.png")
    with pytest.raises(ImageError, match="scan at 600 dpi"):
        only(tmp_path / "bomb.png")


@pytest.mark.parametrize("content", [b"", b"this is a text, no image\n" * 9, b"\x89PNG\r\n\x1a\n"])
def test_a_file_that_is_no_image_is_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "scan.png"
    path.write_bytes(content)
    with pytest.raises(ImageError, match=r"scan\.png") as error:
        only(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["cut.png", "cut.jpg", "cut.tif"])
def test_a_file_that_is_cut_off_is_refused(tmp_path: Path, name: str) -> None:
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 255, (60, 60, 3), dtype=np.uint8)).save(tmp_path / name)
    whole = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ImageError, match="cut"):
        only(tmp_path / name)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match="no such file"):
        only(tmp_path / "none.png")
