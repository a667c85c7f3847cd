"""Images of a board from ROS 1 and 2 bags and MCAP: sensor_msgs/Image or CompressedImage, with JointState.

Every image takes the joint values at its own stamp, between the joint states before and after it. An image during which
a joint moved faster than `max_joint_speed` is left out: its joint values are not those of its exposure. Of images taken
at one stop of the arm the first `max_per_stop` are kept. What is kept is written as a folder (``calib images BAG
--board board.toml --out FOLDER``): ``joints.csv``, ``corners.csv``, ``board.toml``, no images.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calib import files
from calib.data.images.board import Board, read_board, write_board
from calib.data.images.detection import detected
from calib.data.images.image_folders import detection_summary
from calib.data.images.pixels import Detections, write_corners
from calib.data.poses import BOARD, CORNERS, JOINTS
from calib.data.recordings.bags import JOINT_STATE, connections_of, header_stamp, joint_states, opened
from calib.errors import MeasurementError, require

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

IMAGE = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/Image", "sensor_msgs/CompressedImage")
# Type and number of the values of a pixel, by encoding of the message.
ENCODINGS: dict[str, tuple[type[np.generic], int]] = {
    "mono8": (np.uint8, 1),
    "8UC1": (np.uint8, 1),
    "mono16": (np.uint16, 1),
    "16UC1": (np.uint16, 1),
    "bgr8": (np.uint8, 3),
    "rgb8": (np.uint8, 3),
    "8UC3": (np.uint8, 3),
    "bgra8": (np.uint8, 4),
    "rgba8": (np.uint8, 4),
}
# Largest time [s] between an image and the nearest joint state; other images have no joint values.
MAX_DELAY = 0.1
# Largest speed of a joint [rad/s or m/s] at which the arm counts as at rest (our choice).
MAX_JOINT_SPEED = 2e-3
# Largest difference of joint values [rad or m] between images of one stop.
MAX_STOP_DISTANCE = 1e-3
# Largest number of images of one stop that are kept.
MAX_PER_STOP = 3
# Nanoseconds, in which a bag states times, per second.
NANOSECONDS = 1e9


@dataclass(frozen=True, eq=False)
class ImageBag:
    """Usable images of a bag with corners and joint values.

    Attributes:
        names: names of the images kept.
        joint_names: as in the bag.
        q: (m, n) joint values of the images kept [rad or m].
        corners: detected corners of the images kept.
        notes: sentences on the images that were left out.
    """

    names: tuple[str, ...]
    joint_names: tuple[str, ...]
    q: np.ndarray
    corners: Detections
    notes: tuple[str, ...]


def read_image_bag(
    path: Path,
    board: Board,
    image_topic: str = "",
    joint_topic: str = "",
    say: Callable[[int, str], None] | None = None,
) -> ImageBag:
    """Return the detected corners and the joint values of a bag's images.

    Args:
        path: path of the bag (a file, or the folder of a ROS 2 bag).
        board: the board to look for.
        image_topic, joint_topic: topics to read; "": the only topic of the kind in the bag.
        say: called with the number and the name of each image; None: not called.

    Raises:
        MeasurementError: if the bag cannot be read, a topic is missing, or no image was taken at rest.
    """
    with opened(path) as reader:
        states = connections_of(reader, JOINT_STATE, joint_topic, path, "joint states", "--joint-topic")
        names, parts, _ = joint_states(reader, states, None, path)
        few = f"{len(parts['q'])} joint states are too few to interpolate joint values: is the topic the right one?"
        require(len(parts["q"]) >= 2, few, MeasurementError, path)
        order = np.argsort(parts["stamp"], kind="stable")
        connections = connections_of(reader, IMAGE, image_topic, path, "images", "--image-topic")
        image_stamps = _image_stamps(reader, connections)
        chosen, q, notes = _at_rest(image_stamps, parts["stamp"][order], parts["q"][order])
        require(len(chosen), f"no image was taken with the arm at rest: {'; '.join(notes)}", MeasurementError, path)
        labels = [f"image {k + 1}" for k in chosen]
        images = _images(reader, connections, set(chosen.tolist()))

        def show_progress(done: int, total: int, name: str) -> None:
            if say is not None:
                say(done, name)

        detections = detected(zip(labels, images), board, len(labels), show_progress)
    return ImageBag(tuple(labels), names, q, detections, tuple(notes))


def _image_stamps(reader: AnyReader, connections: list[Connection]) -> np.ndarray:
    """Return the time of each image (N,) [ns]: that of its header, else that at which it was logged."""
    stamps = []
    for connection, logged, raw in reader.messages(connections=connections):
        message = reader.deserialize(raw, connection.msgtype)
        stamps.append(header_stamp(message) or logged)
    return np.array(stamps)


def _images(reader: AnyReader, connections: list[Connection], numbers: set[int]) -> Iterator[np.ndarray]:
    """Yield the images with the given numbers as 8-bit grey levels, in the bag's order."""
    for number, (connection, _, raw) in enumerate(reader.messages(connections=connections)):
        if number in numbers:
            message = reader.deserialize(raw, connection.msgtype)
            yield _grey(message)


def _grey(message: Any) -> np.ndarray:
    """Return the 8-bit grey levels (height, width) of a message; raise ValueError for an unknown encoding."""
    from calib.data.images.images import decode, to_grey

    if hasattr(message, "format"):
        return decode(bytes(message.data))
    if message.encoding not in ENCODINGS:
        raise ValueError(f"images of encoding '{message.encoding}'; supported are {', '.join(ENCODINGS)}")
    kind, depth = ENCODINGS[message.encoding]
    order = ">" if message.is_bigendian else "<"
    height = message.height
    width = message.width
    rows = np.frombuffer(bytes(message.data), np.uint8).reshape(height, message.step)
    # rows may be padded
    flat = np.ascontiguousarray(rows[:, : width * depth * np.dtype(kind).itemsize])
    stored = flat.view(np.dtype(kind).newbyteorder(order))
    values = stored.astype(kind).reshape(height, width, depth)
    if depth == 1:
        return to_grey(values[:, :, 0])
    if message.encoding.startswith("rgb"):
        values = values[:, :, 2::-1]
    return to_grey(values)


def _at_rest(images: np.ndarray, stamps: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return the images taken at rest, their joint values, and notes on the other images.

    Args:
        images: (N,) times of the images [ns].
        stamps: (M,) times of the joint states, in ascending order [ns].
        q: (M, n) joint values of the joint states [rad or m].

    Returns:
        Indices (k,) of the images, joint values (k, n) interpolated at their times, and sentences.
    """
    notes = []
    next_state = np.searchsorted(stamps, images)
    after = np.clip(next_state, 1, len(stamps) - 1)
    before = after - 1
    since = images - stamps[before]
    until = images - stamps[after]
    gap = np.maximum(stamps[after] - stamps[before], 1)
    share = np.clip(since / gap, 0.0, 1.0)[:, None]
    q_images = q[before] * (1.0 - share) + q[after] * share
    delay = np.minimum(np.abs(since), np.abs(until))
    has_state = delay < MAX_DELAY * NANOSECONDS
    travel = np.abs(q[after] - q[before]).max(axis=1)
    speed = travel / (gap * 1e-9)
    still = speed < MAX_JOINT_SPEED
    at_rest = np.flatnonzero(has_state & still)
    if not has_state.all():
        count = int((~has_state).sum())
        notes.append(f"{count} images have no joint state within {MAX_DELAY:g} s (do the clocks agree?)")
    moving = int((has_state & ~still).sum())
    if moving:
        notes.append(
            f"{moving} images were taken while the arm moved (faster than {1e3 * MAX_JOINT_SPEED:g} mrad/s): left out"
        )
    selected = []
    images_of_stop = 0
    for k in at_rest:
        same_stop = False
        if selected:
            distance = np.abs(q_images[k] - q_images[selected[-1]]).max()
            same_stop = bool(distance < MAX_STOP_DISTANCE)
        if same_stop:
            images_of_stop += 1
        else:
            images_of_stop = 1
        if images_of_stop <= MAX_PER_STOP:
            selected.append(int(k))
    surplus = len(at_rest) - len(selected)
    if surplus:
        notes.append(f"{surplus} more images of the same stops were left out ({MAX_PER_STOP} of each are kept)")
    return np.array(selected, dtype=int), q_images[selected], notes


def write_image_folder(bag: ImageBag, board: Board, folder: Path) -> Path:
    """Write a bag's images as a folder for `calib.data.images.image_folders`."""
    write_board(board, folder / BOARD)
    header = ["image", *(f"{name} [rad]" for name in bag.joint_names)]
    rows = [[name, *map(float, joints)] for name, joints in zip(bag.names, bag.q)]
    files.write_table(folder / JOINTS, header, rows)
    write_corners(folder / CORNERS, bag.corners)
    return folder


def from_bag(
    bag: Path, board: Path, out: Path, image_topic: str | None, joint_topic: str | None, show: Callable[[str], None]
) -> list[str]:
    """Write a bag's corners and joint values into a folder; return a summary as sentences."""
    printed_board = read_board(board)

    def show_progress(number: int, name: str) -> None:
        show(f"image {number}: {name}")

    contents = read_image_bag(bag, printed_board, image_topic or "", joint_topic or "", show_progress)
    write_image_folder(contents, printed_board, out)
    lines = detection_summary(contents.corners, printed_board, contents.names)
    return [*lines, *contents.notes, f"written to {out}; calib fit ROBOT {out} --out FOLDER fits it"]
