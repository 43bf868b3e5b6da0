"""Photos of taught objects: what is kept, where, and what is refused."""

from pathlib import Path

import pytest

from cell.errors import RequestRefused
from cell.service.photos import LONGEST_PHOTO, Photos

JPEG = b"\xff\xd8\xff\xe0 a photo"
PNG = b"\x89PNG\r\n\x1a\n a drawing"


def test_a_photo_stands_beside_the_model_and_outlives_the_program(tmp_path: Path) -> None:
    model = tmp_path / "parts.model.npz"
    label = "../up/and away"
    Photos(model).put(label, JPEG)
    assert [path.parent.name for path in tmp_path.rglob("*.jpg")] == ["parts.model.photos"]
    photos = Photos(model)
    assert photos.get(label) == (JPEG, "image/jpeg")
    photos.put(label, PNG)
    assert photos.get(label) == (PNG, "image/png")
    assert len([path for path in tmp_path.rglob("*") if path.is_file()]) == 1
    photos.remove(label)
    assert photos.get(label) is None
    assert photos.revision == 2


def test_without_a_model_photos_are_few_and_in_memory() -> None:
    photos = Photos(None)
    for number in range(64):
        photos.put(str(number), JPEG)
    photos.put("0", PNG)
    with pytest.raises(RequestRefused, match="--save"):
        photos.put("64", JPEG)
    assert photos.get("0") == (PNG, "image/png")


@pytest.mark.parametrize(
    "photo", [b"", b"<svg/>", b"GIF89a", JPEG + bytes(LONGEST_PHOTO)], ids=lambda p: str(p[:6])
)
def test_what_is_no_photo_is_refused(photo: bytes) -> None:
    with pytest.raises(RequestRefused):
        Photos(None).put("ball", photo)
