OFFERS = {
    "exports": (
        "nested_tables:translated",
        "recordings.controller_logs:translated",
        "recordings.ros_texts:translated",
        "poses.exports:translated",
        "recordings.controller_logs:with_decimal_points",
    )
}
