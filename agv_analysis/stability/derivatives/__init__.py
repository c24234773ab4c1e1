"""Exact first derivatives of plain scalar functions, at many points at once: forward mode with dual numbers.

    jacobian(control_law, (x_e, y_e, theta_e, v_r, w_r, 25.0, 40.0, 10.0), with_respect_to=(0, 1, 2))

Theory of operation. A dual number holds a value and its derivatives, and arithmetic on it follows the chain rule. Here
value and derivatives are arrays over N points (rows), so that one call of a function written for floats differentiates
it at all of them. What else such a function needs:

* `math` and the builtins `float`, `int`, `min`, `max` accept floats only, or would branch at every call.
  `differentiable` copies a function, and the plain functions that it calls, with versions of these for dual numbers.
* A comparison on which all rows agree is an ordinary bool. Otherwise it raises `Split`, and the function is called
  again for each of the two groups of rows. Rows are put back in order at the end.
* Where both sides of a comparison are equal although their derivatives differ (a tie), a neighbouring point may take
  the other branch. These rows are evaluated along both branches (`Tie`): if value and derivatives agree, as for
  v |v| at 0, the point is differentiable; otherwise it is reported as a `Kink`.

A dual number stores the derivatives with respect to those inputs alone on which it depends. This saves time, and keeps
a zero exact where another factor is not finite: sqrt(x) + y at x = 0 still has the derivative 1 with respect to y.

    jacobians        what is asked for: points and inputs in, values, derivatives and kinks out
    evaluation       calling the function for groups of rows until each has gone its way
    branches         comparisons that rows do not agree on, ties, kinks and their place in the code
    dual             the dual number and its arithmetic
    math_functions   versions of `math` and of builtins for dual numbers
    numpy_functions  the same of numpy
    copies           `differentiable`: functions in which these versions are called
"""

from agv_analysis.stability.derivatives.copies import differentiable
from agv_analysis.stability.derivatives.dual import Dual
from agv_analysis.stability.derivatives.jacobians import Jacobian, Kink, jacobian

__all__ = ["Dual", "Jacobian", "Kink", "differentiable", "jacobian"]
