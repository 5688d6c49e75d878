# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""YAML from anybody: what is plain is read as ever, what is dangerous is refused with its line."""

import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tsobs_ros.yaml_files import load_yaml

PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


@settings(max_examples=30)
@given(PLAIN)
@example({"%TAG": "%TAG"})
def test_plain_data_comes_back(data: object) -> None:
    assert load_yaml(yaml.safe_dump(data)) == data


LAUGHS = "a0: &a0 [x, x]\n" + "".join(
    f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}, *a{i - 1}]\n" for i in range(1, 40)
)
MERGES = "m0: &m0 {x: 1}\n" + "".join(
    f"m{i}: &m{i} {{<<: [*m{i - 1}, *m{i - 1}], y{i}: 1}}\n" for i in range(1, 40)
)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (LAUGHS, "line 2: aliases are not supported"),
        (MERGES, "line 2: merge keys are not supported"),
        ("a: 1" + ":1" * 500_000, "line 1: a number of 1000001 digits"),
        ("%TAG !a! b\n--- 1", "abbreviations of tags are not supported"),
        ("- 1\n" * 150_000, "line 100000: more than 100000 values"),
        ("a" * 2_000_000, "larger than 1048576 bytes"),
        ("[" * 1_000_000, "line 1: nested deeper than 50 levels|line 1: exceeded maximum nesting"),
        ("a: 1\nb: !!python/object/apply:os.system ['true']", "line 2: could not determine a con"),
        ("a: 2001-13-45", "month must be in 1..12"),
        ("a: " + "9" * 5000, "line 1: a number of 5000 digits"),
        ("a: \x01", "special characters are not allowed|control characters are not allowed"),
        ("--- a\n--- b", "line 2: but found another document|found another document"),
        ("? [1, 2]\n: 3", "line 1: found unhashable key"),
    ],
    ids=["laughs", "merges", "base 60", "directive", "many", "large", "deep", "tag", "date",
         "digits", "control", "documents", "key"],
)  # fmt: skip
def test_what_is_dangerous_or_malformed_is_refused_in_one_line(text: str, problem: str) -> None:
    with pytest.raises(ValueError, match=problem) as caught:
        load_yaml(text)

    assert "\n" not in str(caught.value)
