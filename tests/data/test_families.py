from typing import get_args

import numpy as np
import pytest

from jaxshape.data.config import FamilyName
from jaxshape.data.dataset import load_object
from jaxshape.data.families import FAMILIES, TEST_SEEDS, Procedural, procedural_objects
from jaxshape.data.meshes import Model


@pytest.mark.parametrize("family", get_args(FamilyName))
def test_objects_of_a_dataset_are_those_of_their_family_and_seed(family):
    one, other = procedural_objects(family, 2, start=TEST_SEEDS)
    model = load_object(one)
    assert isinstance(model, Model) and model.name == f"{family}-{TEST_SEEDS}"
    assert np.array_equal(model.mesh.vertices, FAMILIES[family](TEST_SEEDS).vertices)
    assert other == Procedural(family, TEST_SEEDS + 1)
