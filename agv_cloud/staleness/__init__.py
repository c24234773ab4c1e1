"""Staleness policies: how the edge uses an outdated pose.

The freshest pose that the edge holds at step k is X_c(k-n). One of three errors goes to the controller, always with the
speeds v_r(k), w_r(k) of now: `hold` compares X_r(k) with X_c(k-n), `align` X_r(k-n) with X_c(k-n), `predict` X_r(k)
with X_c(k-n) moved on by the plant's model. Each is one function, which node and simulation call; `registry` names
them, `estimate` keeps what the edge must know for them.
"""
