"""Camera images: calibration boards to print, folders of images, and images in recordings."""

from calib.data.images.board_print import make as print_board
from calib.data.images.image_bags import from_bag as images_from_bag
from calib.data.images.image_folders import look as look_at_images

__all__ = ["images_from_bag", "look_at_images", "print_board"]
