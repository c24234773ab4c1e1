"""The edge cloud: reference, staleness policies, tracking error, control laws; error detector and controller."""
