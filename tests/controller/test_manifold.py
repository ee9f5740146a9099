"""The manifold functions as vector functions: the two properties of section 6.5.

The conditions of definition 1 on each component are held against the functions in `test_law.py`.
"""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.law import MANIFOLDS

MU = {"tanh": math.tanh(1.0), "sine": math.sin(1.0), "saturation": 1.0}
RHO = 1.0
ROUNDING = 1e-12
NUMBERS = (st.floats(-4.0, 4.0) | st.floats(-1e6, 1e6)).map(
    lambda x: 0.0 if abs(x) < 1e-100 else x  # whose square is lost
)
VECTORS = st.lists(NUMBERS, min_size=1, max_size=7)


def applied(name: str, x: list[float]) -> tuple[np.ndarray, np.ndarray]:
    return np.array(x), np.array([MANIFOLDS[name](each) for each in x])


@pytest.mark.parametrize("name", list(MANIFOLDS))
@given(x=VECTORS)
def test_manifold__any_vector__norm_within_its_bounds(name, x):
    values, f = applied(name, x)
    size = float(np.linalg.norm(values))
    low = MU[name] * min(size, RHO)
    high = size if size < RHO else math.sqrt(len(x)) * RHO
    assert low * (1 - ROUNDING) <= np.linalg.norm(f) <= high * (1 + ROUNDING)


@pytest.mark.parametrize("name", list(MANIFOLDS))
@given(x=VECTORS)
def test_manifold__any_vector__product_with_its_argument_from_below(name, x):
    """The paper writes a strict >, which fails at x = 0, and for saturation inside |x| < 1."""
    values, f = applied(name, x)
    size = float(np.linalg.norm(values))
    assert f @ values >= MU[name] * min(size, RHO) * size * (1 - ROUNDING)


def test_saturation__inside_its_range__product_is_equal_not_greater():
    values, f = applied("saturation", [0.3, -0.4])
    assert f @ values == values @ values


@pytest.mark.parametrize(("name", "rho"), [("tanh", 1.5), ("sine", 1.6), ("saturation", 1.2)])
def test_manifold__wider_rho__condition_outside_needs_a_smaller_mu(name, rho):
    """mu and rho go together: no function here keeps mu beyond the rho it was stated for."""
    assert abs(MANIFOLDS[name](rho)) < MU[name] * rho
