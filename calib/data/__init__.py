OFFERS = {"exports": ("recordings.controller_logs:translated", "poses.exports:translated")}
