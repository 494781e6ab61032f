"""B on the unknowns that it acts on, packed by classes of congruent subdomains."""

import numpy as np
import pytest
import scipy.sparse as sp

from fenics_tfeti.feti.constraints.interface import Interface
from fenics_tfeti.feti.local.congruence import CongruenceClass

pytestmark = pytest.mark.once

# Subdomains 0 and 2 with three unknowns are congruent, 1 has two. B touches the unknowns 1 and 2 of
# the first, 0 of the second, and 0 of the third: for the class of both, these are 0, 1 and 2.
B = np.zeros((3, 8))
B[0, [1, 3]] = 1.0, -1.0
B[1, 2] = 2.0
B[2, [3, 5]] = 0.5, -0.5
CLASSES = [
    CongruenceClass(np.array([0, 2]), np.array([0, 5]), 3),
    CongruenceClass(np.array([1]), np.array([3]), 2),
]
INTERFACE = Interface.build(sp.csr_matrix(B), CLASSES)


def test_unknowns_of_a_class_are_those_of_any_member():
    assert [unknowns.tolist() for unknowns in INTERFACE.unknowns] == [[0, 1, 2], [0]]
    assert INTERFACE.columns.tolist() == [0, 1, 2, 5, 6, 7, 3]
    np.testing.assert_array_equal(INTERFACE.matrix.toarray(), B[:, INTERFACE.columns])
    np.testing.assert_array_equal(INTERFACE.transposed.toarray(), B[:, INTERFACE.columns].T)
    # a rank without subdomains
    empty = Interface.build(sp.csr_matrix((0, 0)), [])
    assert empty.blocks(np.zeros(0)) == [] and empty.pack([]).size == 0


def test_blocks_have_a_row_for_each_member():
    packed = np.arange(7.0)
    first, second = INTERFACE.blocks(packed)
    assert first.tolist() == [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]
    assert second.tolist() == [[6.0]]
    np.testing.assert_array_equal(INTERFACE.pack([first, second]), packed)


def test_an_operator_for_each_class():
    result = INTERFACE.apply([lambda rows: rows[:, ::-1], lambda rows: -rows], np.arange(7.0))
    assert result.tolist() == [2.0, 1.0, 0.0, 5.0, 4.0, 3.0, -6.0]
