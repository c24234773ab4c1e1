"""Sweeps: the loop at every point of a grid of parameters, under many seeds.

    plan      what is to be run: axes, points, seeds, and the parts that it is done in
    execute   parts on all cores of this machine, or on a Dask cluster
    store     parts kept on disk as they are done, so that a sweep that was stopped can go on
    collect   all rows, from the parts that are done and those that are still to be run
    summary   one row a point: probability of instability with its confidence interval, quantiles of the metrics
    corridors which outages keep the AGV in its corridor at each point, and how often it leaves
    verdicts  the word on each point, by the rules of `agv-ncs stability`
    rows_file rows as CSV or Parquet
    borders   where the loop ceases to be stable along a straight track, by theory
    axis_words what the axes are called for people
    picture   curve or heat map of a metric, with these borders

Seeds are paired: under one seed all points with the same channel meet the same outages.
"""

METRICS = (
    "settle_1cm_steps", "settle_2pct_steps", "overshoot", "iae", "ise", "peak", "final", "position_peak",
    "position_final", "deviation_max", "deviation_p99", "deviation_rms", "speed_max", "n_ul_max",
    "n_ul_mean",
)  # fmt: skip
"""Metrics of which a point has the median (_p50) and the 95th percentile (_p95) over the seeds."""

CORRIDOR_COLUMNS = (
    "n_single", "n_any", "p_lap", "p_lap_low", "p_lap_high", "p_hour", "p_hour_low", "p_hour_high", "mean_time_s",
    "rms_deviation",
)  # fmt: skip
"""What a point with a corridor says of it, see docs/corridor.md."""

MOST_POINTS = 200
"""Points up to which a sweep gives verdicts by default: each takes a fraction of a second."""
