"""Constants of compiled functions in one flat array."""

import numpy as np
import pytest

from makebreak.systems.arm.numerics.impedance_controller import (
    ForceLaw,
    Law,
    law_of,
    tick,
    warm_up,
)
from makebreak.systems.arm.numerics.packed import packed
from makebreak.systems.arm.numerics.serial_chain import SerialChain, chain_of
from makebreak.systems.numerics.joint_laws import N_NUMBERS, JointLaws


def chain_and_law(n, m):
    """Of n joints and m laws of joints, all numbers different."""
    rng = np.random.default_rng(n)
    shapes = [(n, 3, 3), (n, 3), (n,), (n, 3), (n,), (n, 3), (n, 3, 3), (n,), (n,)]
    chain = SerialChain(
        *(rng.uniform(0.5, 1.5, s) for s in (*shapes, (3,), (3, 3), (3,)))
    )
    arrays = (rng.uniform(0.5, 1.5, s) for s in (*6 * [(n,)], (3, 3), (6,), (6,)))
    numbers = (*rng.uniform(0.5, 1.5, 4), 12, bool(n % 2), *rng.uniform(0.5, 1.5, 1))
    laws = JointLaws(*rng.integers(0, 6, (2, m)), rng.uniform(0.5, 1.5, (m, N_NUMBERS)))
    return chain, Law(*arrays, *numbers, ForceLaw(*rng.uniform(0.5, 1.5, 7)), laws)


def leaves(constants):
    for name, value in constants._asdict().items():
        yield from leaves(value) if hasattr(value, "_fields") else [(name, value)]


@pytest.mark.parametrize("n, m", [(1, 1), (2, 3), (7, 2)])
def test_what_is_unpacked_is_what_was_packed(n, m):
    for unpack, constants in zip((chain_of, law_of), chain_and_law(n, m), strict=True):
        found = unpack(packed(constants))
        for (name, value), (_, expected) in zip(
            leaves(found), leaves(constants), strict=True
        ):
            np.testing.assert_array_equal(value, expected, name, strict=True)


def test_what_is_packed_is_a_copy():
    chain, _ = chain_and_law(2, 1)
    flat = packed(chain)
    before = chain.mass.copy()
    chain.mass[:] = 0.0
    np.testing.assert_array_equal(chain_of(flat).mass, before)


def test_arms_of_all_sizes_share_their_compiled_code():
    for n, m in ((1, 1), (2, 3), (7, 2)):
        warm_up(*(packed(each) for each in chain_and_law(n, m)), n)
    assert len(tick.signatures) == 1
