"""Images of a board: boards to print, corners found in images and bags, lenses estimated from them."""

OFFERS = {
    "commands": "commands:app",
    "topics": ":TOPICS",
    "image_folders": "image_folders:",
    "camera_guess": "camera_guess:",
}
TOPICS = {
    "images": (
        "a folder of images of a board, its board.toml, camera.yaml, corners.csv",
        (
            "calib.rooms.camera.image_folders",
            "calib.data.camera.board",
            "calib.data.camera.camera_info",
            "calib.rooms.camera.corner_file",
            "calib.rooms.camera.image_bags",
        ),
    )
}
