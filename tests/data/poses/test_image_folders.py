"""Claims: a folder of images is read like a measurement file; what is of no use in it is said, image by image."""

import os
from functools import cache

import cv2
import numpy as np
import pytest

from calib.data.images.board import read_board
from calib.data.images.image_bags import read_image_bag, write_image_folder
from calib.data.images.image_folders import problem_words, read_images
from calib.data.images.lens import Lens, write_lens
from calib.data.poses import is_image_folder
from calib.data.poses.fit_options import parse_options
from calib.errors import MeasurementError
from calib.simulation import camera_cell as camera
from calib.simulation.cell import SimulatedInstrument
from calib.simulation.virtual_cells import rigid, virtual_cell

LENS = Lens("pinhole", np.array([470.0, 471.0, 240.0, 178.0, -0.12, 0.05, 4e-4, -3e-4, 0.0]), (480, 360))


@cache
def cell() -> camera.CameraCell:
    board = camera.Board("charuco", 6, 5, 0.04, 0.03, "4x4_50")
    arm = rigid(virtual_cell("lwr4plus", instrument=SimulatedInstrument(encoder_sigma=0.0)))
    return camera.camera_cell(arm, lens=LENS, board=board, reach_of_arm=0.75)


@cache
def joints() -> np.ndarray:
    return camera.views(cell(), 7, 1, camera.Views((0.3, 0.45), 0.5))


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    return camera.take_pictures(cell(), joints(), tmp_path_factory.mktemp("shots"), seed=1)


@pytest.fixture
def folder(taken, tmp_path):
    for path in taken.iterdir():
        if path.name != "corners.csv":
            (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


def read(path, **options):
    return read_images(path, cell().cell.nominal.joint_names, parse_options(options))


def test_corners_are_looked_for_once(folder):
    """Corners come with joints and are looked for once."""
    block = read(folder)
    assert is_image_folder(folder) and block.kind == "pixels" and len(block) == 7
    assert block.q == pytest.approx(joints(), abs=1e-9)
    exact = camera.photograph(cell(), joints(), 0.0)
    both = block.seen & exact.seen
    assert both.sum() > 100 and np.sqrt(np.mean((block.pixel - exact.pixel)[both] ** 2)) < 0.08
    before = (folder / "corners.csv").read_text()
    for image in folder.glob("*.png"):
        image.unlink()
    again = read(folder)
    assert np.array_equal(again.seen, block.seen) and again.size == LENS.size
    assert np.nanmax(np.abs(again.pixel - block.pixel)) < 1e-8
    assert (folder / "corners.csv").read_text() == before


def test_corners_without_images_are_read_however_old(folder):
    """A folder without images is read from its corners, however old; those of other images are refused."""
    block = read(folder)
    for image in folder.glob("*.png"):
        image.unlink()
    os.utime(folder / "corners.csv", (0, 0))
    assert np.array_equal(read(folder).seen, block.seen)
    table = folder / "joints.csv"
    table.write_text(table.read_text().replace(".png", ".jpg"))
    with pytest.raises(MeasurementError, match=r"joints.csv and corners.csv disagree: .*\.jpg.*\.png"):
        read(folder)


def test_useless_images_are_left_out(folder):
    """Useless images are left out and said to be so."""
    (folder / "0002.png").write_bytes(b"\x89PNG cut short")
    image = cv2.imread(str(folder / "0004.png"), 0)
    cv2.imwrite(str(folder / "0004.png"), np.ascontiguousarray(np.rot90(image)))
    cv2.imwrite(str(folder / "0005.png"), np.full_like(image, 90))
    (folder / "0006.png").rename(folder / "extra.png")
    block = read(folder)
    assert block.rows.tolist() == [1, 3, 7] and block.name(3) == "0003.png"
    notes = " | ".join(block.notes)
    assert "1 of 7 rows have no image: 0006.png" in notes and "no row in joints.csv: extra.png" not in notes
    assert "(cannot be read as an image" in notes and "was it copied whole?): 0002.png" in notes
    assert "360 x 480 pixels, where most are 480 x 360; did a program rotate it?): 0004.png" in notes
    assert "(no board found: out of view, hidden, blurred or in glare): 0005.png" in notes


def test_too_few_images_refused_with_reasons(folder):
    """Too few usable images are refused with the reasons."""
    for name in ("0001", "0002", "0003", "0004", "0005"):
        (folder / f"{name}.png").write_bytes(b"")
    with pytest.raises(MeasurementError, match=r"2 usable images: .*5 images are not usable .*the file is empty"):
        read(folder)


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda f: (f / "board.toml").unlink(), "has no board.toml"),
        (lambda f: (f / "joints.csv").unlink(), "has no joints.csv"),
        (lambda f: (f / "joints.csv").write_text((f / "joints.csv").read_text().replace("0002", "0001")), "2 times"),
        (lambda f: [p.unlink() for p in f.glob("*.png")], "none of the images named in joints.csv exists"),
        (
            lambda f: write_lens(Lens(LENS.model, LENS.values, (640, 480)), f / "camera.yaml"),
            "is for images of 640 x 480 pixels, but the images here have 480 x 360",
        ),
    ],
)
def test_incomplete_folder_is_refused(change, words, folder):
    """A folder that lacks something is refused."""
    change(folder)
    with pytest.raises(MeasurementError, match=words):
        read(folder)


def test_stated_lens_is_kept_unless_fitted(folder):
    """A stated lens is kept unless it is to be fitted."""
    write_lens(LENS, folder / "camera.yaml")
    assert read(folder).known and not read(folder).free
    fitted = read(folder, camera={"intrinsics": "fit", "board": ["bend"]})
    assert {"fx", "k1", "bend_xx"} <= set(fitted.free) and "scale" not in fitted.free


def test_a_lens_under_another_name_is_read_and_said(folder):
    """A lens file of any name is read, and said; two are refused, and a YAML without a lens is said."""
    write_lens(LENS, folder / "left.yaml")
    (folder / "notes.yaml").write_text("a: 1")
    block = read(folder)
    assert block.known and "the lens is read from left.yaml" in block.notes
    assert any(note.startswith("notes.yaml is not read as a lens") for note in block.notes)
    write_lens(LENS, folder / "right.yaml")
    with pytest.raises(MeasurementError, match="several files with a lens"):
        read(folder)


def write_bag(path, compressed: bool, moving: int) -> None:
    """Write a ROS 2 bag: joint states at 100 Hz, an image at each stop, and one while the arm moves."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    header, time = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    kind = "sensor_msgs/msg/CompressedImage" if compressed else "sensor_msgs/msg/Image"
    names = list(cell().cell.nominal.joint_names)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        states = writer.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=store)
        images = writer.add_connection("/camera/image", kind, typestore=store)
        stamp = 1_000_000_000
        for number, q in enumerate(joints()):
            for step in range(40):
                own = q + (0.01 * step if number == moving else 0.0)
                head = header(time(stamp // 10**9, stamp % 10**9), "")
                message = types["sensor_msgs/msg/JointState"](head, names, own, np.zeros(7), np.zeros(7))
                writer.write(states, stamp, store.serialize_cdr(message, "sensor_msgs/msg/JointState"))
                if step == 20:
                    pixels = cv2.imread(str(write_bag.folder / f"{number + 1:04}.png"), 0)
                    if compressed:
                        found = types[kind](head, "png", cv2.imencode(".png", pixels)[1].ravel())
                    else:
                        found = types[kind](head, *pixels.shape, "mono8", 0, pixels.shape[1], pixels.ravel())
                    writer.write(images, stamp, store.serialize_cdr(found, kind))
                stamp += 10_000_000


@pytest.mark.slow
@pytest.mark.parametrize("compressed", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_images_of_bag_take_stamped_joints(compressed, folder, tmp_path):
    """Images of a bag take the joints of their stamps."""
    write_bag.folder = folder
    write_bag(tmp_path / "bag", compressed, moving=2)
    board = read_board(folder)
    found = read_image_bag(tmp_path / "bag", board)
    assert len(found.names) == 6 and "1 images were taken while the arm moved" in found.notes[0]
    assert found.q == pytest.approx(np.delete(joints(), 2, axis=0), abs=1e-9)
    block = read(write_image_folder(found, board, tmp_path / "out"))
    assert len(block) == 6
    direct = read(folder)
    assert np.nanmax(np.abs(block.pixel - np.delete(direct.pixel, 2, axis=0))) < 1e-6
    with pytest.raises(MeasurementError, match="has no images on '/camera'"):
        read_image_bag(tmp_path / "bag", board, "/camera")


def test_reasons_tell_range_of_their_numbers():
    """One sentence per reason tells the range of its numbers."""
    blurred = {
        f"{k}.png": f"no board found; the image's sharpest edges are {width} px wide" for k, width in ((1, 9), (2, 12))
    }
    other = {"3.png": "no markers of 4x4_50, but some of 5x5_100: state it"}
    assert problem_words({**blurred, "4.png": "", **other}) == [
        "2 images are not usable (no board found; the image's sharpest edges are 9 to 12 px wide): 1.png, 2.png",
        "1 image is not usable (no markers of 4x4_50, but some of 5x5_100: state it): 3.png",
    ]
