"""Images of a board: boards to print, corners found in images and bags, lenses estimated from them."""

OFFERS = {
    "commands": "commands:app",
    "topics": ":TOPICS",
    "detect_boards": "detection:detected",
    "estimate_lens": "intrinsics:estimate_lens",
}
TOPICS = {
    "images": (
        "a folder of images of a board, its board.toml, camera.yaml, corners.csv",
        (
            "calib.data.poses.image_folders",
            "calib.data.camera.board",
            "calib.data.camera.camera_info",
            "calib.data.camera.corner_file",
            "calib.rooms.camera.image_bags",
        ),
    )
}
