"""Is the loop stable under outages? Six answers, one module each, because they answer different questions.

    paper        |lambda| < 1 for A(k) at every step: blind to outages on a straight track
    lifted       the pose is n steps old at every step, speeds frozen: a delay; over a lap that turns: `floquet`
    bursts       up to n losses in a row, in any order, forever: a joint spectral radius, bounded from both sides
    mean_square  random losses, E[|e|^2] dies out: a Markov jump linear system; `almost_sure`: almost every run does
    both_links   the same where commands are lost as well
    floquet      one lap, or one recorded sequence of losses, again and again: what that very lap does
    late_and_lost  the same where poses come late as well; `variable_delay` for one recorded sequence of ages
    empirical    twins that begin apart and meet the same losses: do they come together?

All but the first and the last start from `linearisation`: e(k+1) = F(k) e(k) + G(k) e(k-n).

What counts as stable is the same everywhere: a small error dies out over the lap. A parked AGV cannot move sideways or
turn, so the error across the track is neutral while it stands. Criteria at frozen speeds therefore leave neutral
multipliers out, criteria over a lap let the lap as a whole decide, and on a track that never moves only the errors that
the commands can reach are judged. An error that neither grows nor dies out is not stable.

`margins` puts the numbers side by side, `margin_map` spreads them over two parameters, `gains` finds the best K_x.

`evidence` brings together what is known of a run or a scenario: the criteria, how surely the link was seen
(`confidence`), whether the recorded commands are those of the law (`driven_commands`), and what the nonlinear loop does
under the losses again and again (`repeated_run`). `verdict` makes one word of it.
"""
