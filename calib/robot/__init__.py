OFFERS = {"descriptions": "descriptions.reading:"}
