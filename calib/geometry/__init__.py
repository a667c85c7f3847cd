OFFERS = {"optics": "camera.camera_guess:optics_of"}
