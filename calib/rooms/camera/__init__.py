"""Camera calibration with a board: boards to print, corner detection in images and bags, lens estimation."""

OFFERS = {
    "commands": "commands:app",
    "topics": ":TOPICS",
    "image_folders": "pictures.image_folders:",
    "camera_guess": "camera_guess:",
    "optics": "camera_guess:optics_of",
    "read_optics": "optics:read_optics",
    "camera_view": "camera_view:camera_view",
    "fit_notes": "image_findings:image_notes",
    "image_coverage": "image_findings:image_coverage",
    "image_words": "image_findings:image_words",
    "reprojection": "image_findings:reprojection",
    "read_lens": "lens:read_lens",
    "read_board": "board:read_board",
}
TOPICS = {
    "images": (
        "a folder of images of a board, its board.toml, camera.yaml, corners.csv",
        "calib.rooms.camera.pictures.image_folders calib.rooms.camera.board calib.rooms.camera.lens "
        "calib.rooms.camera.pixels calib.rooms.camera.pictures.image_bags",
    )
}
