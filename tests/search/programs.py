"""What a program of JAX consists of."""

import jax.extend as jex


def equations_inside(jaxpr):
    """Every equation of a program, with those of its inner programs."""
    for equation in jaxpr.eqns:
        yield equation
        for value in equation.params.values():
            for inner in value if isinstance(value, tuple | list) else (value,):
                if isinstance(inner, jex.core.ClosedJaxpr):
                    yield from equations_inside(inner.jaxpr)
                elif isinstance(inner, jex.core.Jaxpr):
                    yield from equations_inside(inner)


def largest(jaxpr):
    """Numbers in the largest array that a program makes."""
    return max(v.aval.size for equation in equations_inside(jaxpr) for v in equation.outvars)
