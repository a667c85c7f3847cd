OFFERS = {"steps": ("session.certificate:STEP", "session.second_round:STEP")}
