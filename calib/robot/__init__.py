OFFERS = {"descriptions": "descriptions.urdf_conversion:"}
