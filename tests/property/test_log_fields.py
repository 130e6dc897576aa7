"""Names of fields: legal for ROS 2, and each says which variable it stands for."""

from __future__ import annotations

import re

import pytest
from hypothesis import given, strategies as st

from pbonet.log.fields import OWN, field_name, variable_name

LEGAL = re.compile(r"(?!.*__)(?!.*_$)[a-z][a-z0-9_]*")
NAMES = st.from_regex(r"[A-Za-z_][A-Za-z0-9_^'.]{0,14}", fullmatch=True) | st.text(
    alphabet="X_4Ax^", min_size=1, max_size=12
).filter(lambda text: text[0] in "XAx_")
NAMES |= st.sampled_from([name.upper() for name in sorted(OWN)])


@given(NAMES)
def test_fields_are_legal_and_lead_back(name) -> None:
    field = field_name(name)
    assert LEGAL.fullmatch(field)
    assert variable_name(field) == name


@pytest.mark.parametrize(
    ("name", "field"),
    [
        *(("Q_MEZ", "q_mez"), ("Q^_MEZ", "q_x5e_mez"), ("X41", "x5841"), ("T", "t")),
        *(("NUMBER", "x4eumber"), ("X4EUMBER", "x584eumber"), ("NUMBERS", "numbers")),
    ],
)
def test_fields_of_names_as_they_are(name, field) -> None:
    assert field_name(name) == field
