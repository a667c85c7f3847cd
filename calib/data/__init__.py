OFFERS = {
    "exports": ("recordings.controller_logs:translated", "recordings.ros_texts:translated", "poses.exports:translated")
}
