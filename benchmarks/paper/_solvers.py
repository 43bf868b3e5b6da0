"""The eigenvalue solvers that the paper weighs against each other, written plainly.

Each takes symmetric matrices (n, 4, 4) and returns what it finds, (n,): the eigenvalue of smallest
magnitude, or of largest where its name says so. All arithmetic stays in the matrices' own type, so
that single precision can be measured as well. numpy calls LAPACK in double precision alone; single
precision goes through scipy, one matrix at a time.
"""

import numpy as np
from scipy import linalg

STEPS = 60


def _lapack(name: str, *arrays: np.ndarray) -> np.ndarray:
    """Call eigvals, eigvalsh, inv or solve in the type of the arrays."""
    if arrays[0].dtype == np.float64:
        return getattr(np.linalg, name)(*arrays)
    found = np.array([getattr(linalg, name)(*one) for one in zip(*arrays, strict=True)])
    if found.dtype not in (np.float32, np.complex64):
        raise SystemExit(f"{name} left single precision: {found.dtype}")
    return found


def characteristic_coefficients(Q: np.ndarray) -> np.ndarray:
    """Return the polynomial's coefficients, highest power first, by Faddeev and Le Verrier."""
    n = Q.shape[-1]
    identity = np.eye(n, dtype=Q.dtype)
    out = np.ones((len(Q), n + 1), dtype=Q.dtype)
    M = np.zeros_like(Q)
    for k in range(1, n + 1):
        M = Q @ M + out[:, k - 1, None, None] * identity
        out[:, k] = -np.trace(Q @ M, axis1=1, axis2=2) / Q.dtype.type(k)
    return out


def _smallest_real(roots: np.ndarray) -> np.ndarray:
    """Return the real part of the root of smallest magnitude: imaginary parts are rounding."""
    place = np.argmin(np.abs(roots), axis=1)
    return np.real(np.take_along_axis(roots, place[:, None], axis=1)[:, 0])


def closed_form(Q: np.ndarray) -> np.ndarray:
    """Solve the characteristic polynomial by Ferrari's formula."""
    complex_type = np.complex64 if Q.dtype == np.float32 else np.complex128
    _, b, c, d, e = (one.astype(complex_type) for one in characteristic_coefficients(Q).T)
    # depressed quartic y^4 + p y^2 + q y + r, y = x + b / 4
    p = c - 3 * b**2 / 8
    q = d - b * c / 2 + b**3 / 8
    r = e - b * d / 4 + b**2 * c / 16 - 3 * b**4 / 256
    third, half = complex_type(1 / 3), complex_type(0.5)
    # its resolvent z^3 + 2 p z^2 + (p^2 - 4 r) z - q^2 by Cardano, then two quadratics
    c2, c1, c0 = 2 * p, p**2 - 4 * r, -(q**2)
    s = c1 - c2**2 / 3
    t = 2 * c2**3 / 27 - c2 * c1 / 3 + c0
    root = np.sqrt(t**2 / 4 + s**3 / 27)
    plus, minus = -t / 2 + root, -t / 2 - root
    u = np.where(np.abs(plus) > np.abs(minus), plus, minus) ** third
    turn = complex_type(np.exp(2j * np.pi / 3))
    candidates = np.stack([u * turn**k - s / (3 * u * turn**k) - c2 / 3 for k in range(3)])
    place = np.argmax(np.abs(candidates), axis=0)
    z = np.take_along_axis(candidates, place[None], axis=0)[0]
    m = np.sqrt(z)
    roots = []
    for sign in (1, -1):
        inner = np.sqrt(m**2 - 4 * ((p + z) * half - sign * q / (2 * m)))
        roots += [(-sign * m + inner) * half, (-sign * m - inner) * half]
    return _smallest_real(np.stack(roots, axis=1) - (b / 4)[:, None])


def companion(Q: np.ndarray) -> np.ndarray:
    """Take the eigenvalues of the companion matrix of the characteristic polynomial."""
    coefficients = characteristic_coefficients(Q)
    n = Q.shape[-1]
    C = np.zeros_like(Q)
    C[:, 0, :] = -coefficients[:, 1:]
    C[:, range(1, n), range(n - 1)] = 1
    return _smallest_real(_lapack("eigvals", C))


def power_largest(Q: np.ndarray) -> np.ndarray:
    """Iterate v <- Q v: the eigenvalue of largest magnitude, by Rayleigh's quotient."""
    v = np.ones((len(Q), Q.shape[-1], 1), dtype=Q.dtype)
    for _ in range(STEPS):
        v = Q @ v
        v /= np.linalg.norm(v, axis=1, keepdims=True)
    return (np.swapaxes(v, 1, 2) @ Q @ v)[:, 0, 0]


def power_shifted(Q: np.ndarray) -> np.ndarray:
    """Find lambda_min by the power method on Q minus the largest eigenvalue's estimate."""
    top = power_largest(Q)
    shifted = Q - top[:, None, None] * np.eye(Q.shape[-1], dtype=Q.dtype)
    return power_largest(shifted) + top


def inverse_by_solving(Q: np.ndarray) -> np.ndarray:
    """Iterate v <- Q^-1 v by LU with pivots: the eigenvalue of smallest magnitude."""
    v = np.ones((len(Q), Q.shape[-1], 1), dtype=Q.dtype)
    for _ in range(STEPS):
        v = _lapack("solve", Q, v)
        v /= np.linalg.norm(v, axis=1, keepdims=True)
    return (np.swapaxes(v, 1, 2) @ Q @ v)[:, 0, 0]


def inverse_power(Q: np.ndarray) -> np.ndarray:
    """Form Q^-1 and take the power method's eigenvalue of it."""
    return 1 / power_largest(_lapack("inv", Q))


def qr_general(Q: np.ndarray) -> np.ndarray:
    """LAPACK's QR for matrices of any kind, ``numpy.linalg.eigvals``."""
    return _smallest_real(_lapack("eigvals", Q))


def qr_symmetric(Q: np.ndarray) -> np.ndarray:
    """LAPACK's QR for symmetric matrices, ``numpy.linalg.eigvalsh``."""
    return _smallest_real(_lapack("eigvalsh", Q))
