import board_photos
import pytest


@pytest.fixture(scope="session")
def photos(tmp_path_factory):
    """A folder of six photographs of the truth board, and the true keypoints by name; no test may change it."""
    folder = tmp_path_factory.mktemp("truth-board") / "photos"
    return folder, board_photos.write_photos(folder, 6)
