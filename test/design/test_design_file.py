# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Design files: what is written is read back to the last bit, and nothing else is believed."""

import copy
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tsobs_ros.design.file import load_design, load_request, parse_design, save_design
from tsobs_ros.design.record import Design, SolverReport
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.errors import CertificateError, DesignFileError, ModelError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise

PROPERTY = settings(
    max_examples=60,
    # The file is written anew by every example.
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def floats(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_subnormal=False)


TERMS = st.one_of(
    st.just(DisturbanceTerm("clean")),
    st.builds(lambda d, i: DisturbanceTerm("bias", {"density": d, "initial_std": i}),
              floats(0.0, 1.0), floats(0.0, 1.0)),
    st.builds(lambda s, t: DisturbanceTerm("gauss_markov", {"std": s, "time_constant": t}),
              floats(1e-3, 1.0), floats(0.1, 100.0)),
    st.builds(lambda f: DisturbanceTerm("sinusoid", {"frequency": f}), floats(0.1, 50.0)),
    st.builds(lambda r: DisturbanceTerm("ramp", {"rate_density": r}), floats(0.0, 1.0)),
)  # fmt: skip
REQUESTS = st.builds(
    ArmRequest,
    arm=st.builds(
        ElasticJointArm, floats(0.1, 10.0), floats(0.1, 10.0), floats(0.1, 100.0),
        floats(0.1, 100.0), floats(0.0, 10.0), floats(0.0, 10.0),
    ),
    disturbance=st.lists(TERMS, min_size=1, max_size=3),
    process_noise=st.builds(ProcessNoise, floats(0.0, 1.0), floats(0.0, 1.0)),
    measurement_std=floats(1e-4, 1.0),
    rate=floats(25.0, 1000.0),
    x_max=floats(0.01, math.pi),
    decay_rate=floats(0.0, 10.0),
    initial_std=st.tuples(*[floats(0.01, 10.0)] * 4),
    uncertainty=st.dictionaries(st.sampled_from(["stiffness", "gravity"]), floats(0.01, 0.5)),
)  # fmt: skip
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
SOLVERS = st.builds(
    SolverReport, st.text(max_size=20), st.text(max_size=20), st.text(max_size=20),
    st.integers(0, 1000), floats(0.0, 1e3), floats(0.0, 1.0),
)  # fmt: skip


@st.composite
def designs(draw: st.DrawFn) -> Design:
    """Designs of every shape with matrices of any finite numbers; their certificates are false."""
    request = draw(REQUESTS)
    n = request.flow.state_count
    return Design(
        request,
        P=draw(hnp.arrays(np.float64, (n, n), elements=NUMBERS)),
        K=draw(hnp.arrays(np.float64, (n, 1), elements=NUMBERS)),
        solver=draw(SOLVERS),
    )


@PROPERTY
@given(design=designs())
def test_a_design_is_read_back_to_the_last_bit(design: Design, tmp_path: Path) -> None:
    path = tmp_path / "a.design.yaml"
    save_design(design, path)
    again = parse_design(path)
    assert again.request == design.request
    assert again.P.tobytes() == design.P.tobytes()
    assert again.K.tobytes() == design.K.tobytes()
    assert again.solver == design.solver


def test_the_shipped_file_is_what_saving_its_design_writes(
    shipped: Design, shipped_file: Path, tmp_path: Path
) -> None:
    path = tmp_path / "again.yaml"
    save_design(shipped, path)
    assert path.read_text(encoding="utf-8") == shipped_file.read_text(encoding="utf-8")
    assert load_design(path).certificate == shipped.certificate


def test_saving_replaces_a_file_and_leaves_nothing_beside_it(
    shipped: Design, tmp_path: Path
) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("old")
    save_design(shipped, path)
    assert load_design(path).request == shipped.request
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.yaml"]


def test_a_file_that_cannot_be_written_is_named(shipped: Design, tmp_path: Path) -> None:
    with pytest.raises(DesignFileError, match=r"no/a\.yaml: cannot write the design file: No such"):
        save_design(shipped, tmp_path / "no" / "a.yaml")


@pytest.fixture(scope="module")
def valid(shipped_file: Path) -> dict[str, Any]:
    """The shipped file as plain data; tests change copies of it."""
    data: dict[str, Any] = yaml.safe_load(shipped_file.read_text(encoding="utf-8"))
    return data


def written(folder: Path, data: Any) -> Path:
    path = folder / "my.yaml"
    path.write_text(data if isinstance(data, str) else yaml.safe_dump(data), encoding="utf-8")
    return path


def changed(data: dict[str, Any], place: tuple[Any, ...], value: Any) -> dict[str, Any]:
    """Return a copy with the entry at `place` set, or removed if the value is `...`."""
    result = copy.deepcopy(data)
    entry: Any = result
    for key in place[:-1]:
        entry = entry[key]
    if value is ...:
        del entry[place[-1]]
    else:
        entry[place[-1]] = value
    return result


DEFAULTED = [
    ("arm",), ("disturbance",), ("process_noise",), ("measurement_std",), ("rate",), ("x_max",),
    ("decay_rate",), ("initial_std",), ("arm", "stiffness"), ("arm", "link_damping"),
    ("process_noise", "motor"), ("disturbance", 0, "density"), ("disturbance", 0, "initial_std"),
]  # fmt: skip


@pytest.mark.parametrize("place", DEFAULTED, ids=lambda place: ".".join(map(str, place)))
def test_what_a_file_leaves_out_has_its_default(
    valid: dict[str, Any], place: tuple[Any, ...], tmp_path: Path
) -> None:
    path = written(tmp_path, changed(valid, ("design", *place), ...))
    assert load_design(path).request == ArmRequest()


def test_a_request_may_leave_out_everything(tmp_path: Path) -> None:
    assert load_request(written(tmp_path, "design: {}")) == ArmRequest()
    assert load_request(written(tmp_path, "{}")) == ArmRequest()


def test_a_request_is_a_design_files_first_part_or_stands_alone(
    shipped: Design, shipped_file: Path, tmp_path: Path
) -> None:
    assert load_request(shipped_file) == shipped.request
    path = written(tmp_path, "rate: 100\ndisturbance: [{kind: sinusoid, frequency: 3}]\n")
    expected = ArmRequest(rate=100.0, disturbance=[DisturbanceTerm("sinusoid", {"frequency": 3})])
    assert load_request(path) == expected


def test_a_number_without_a_point_is_still_a_number(tmp_path: Path) -> None:
    """YAML 1.1 reads 1e-4 as text."""
    path = written(tmp_path, "process_noise: {link: 1e-4, motor: 1e-5}\nrate: 2e2\nx_max: 1\n")
    request = load_request(path)
    assert request == replace(ArmRequest(), x_max=1.0)


MALFORMED: list[tuple[tuple[Any, ...], Any, str]] = [
    (("format",), ..., "format: expected 'tsobs_ros design', got None"),
    (("format",), "rosbag", "format: expected 'tsobs_ros design', got 'rosbag'"),
    (("version",), 2, "version: expected 1, got 2"),
    (("version",), True, "version: expected 1, got True"),
    (("version",), 1.0, "version: expected 1, got 1.0"),
    (("version",), ..., "version: expected 1, got None"),
    (("notes",), "mine", "the file: unknown entry 'notes', expected some of format, version"),
    (("design",), ..., "design: expected a mapping, got None"),
    (("design",), [1], r"design: expected a mapping, got \[1\]"),
    (("design", 3), 4, "design: expected a mapping"),
    (("design", "speed"), 3.0, "design: unknown entry 'speed', expected some of arm"),
    (("design", "rate"), "fast", "design.rate: expected a number, got 'fast'"),
    (("design", "rate"), True, "design.rate: expected a number, got True"),
    (("design", "rate"), None, "design.rate: expected a number, got None"),
    (("design", "rate"), [200.0], r"design.rate: expected a number, got \[200.0\]"),
    (("design", "rate"), math.nan, "design.rate: expected a finite number, got nan"),
    (("design", "rate"), "inf", "design.rate: expected a finite number, got inf"),
    (("design", "rate"), 10**400, "design.rate: expected a finite number, got 1000000"),
    (("design", "rate"), 0.0, "rate: expected a finite number above 0, got 0.0"),
    (("design", "x_max"), 4.0, "x_max: expected 0 < x_max <= π, got 4.0"),
    (("design", "arm"), 3.0, "design.arm: expected a mapping, got 3.0"),
    (("design", "arm", "mass"), 3.0, "design.arm: unknown entry 'mass', expected some of link_in"),
    (("design", "arm", "stiffness"), "soft", "design.arm.stiffness: expected a number, got 'soft'"),
    (("design", "arm", "stiffness"), -1.0, "stiffness: expected a finite number above 0, got -1.0"),
    (("design", "process_noise", "wind"), 1.0, "design.process_noise: unknown entry 'wind'"),
    (("design", "process_noise", "link"), -1.0, "process noise density of the link: expected"),
    (("design", "initial_std"), [1.0], "design.initial_std: expected a list of 4, got 1"),
    (("design", "initial_std"), 1.0, "design.initial_std: expected a list of 4, got 1.0"),
    (("design", "initial_std", 2), "x", r"design.initial_std\[2\]: expected a number, got 'x'"),
    (("design", "initial_std", 2), 0.0, "initial_std: expected values above 0"),
    (("design", "disturbance"), "bias", "design.disturbance: expected a list, got 'bias'"),
    (("design", "disturbance"), [], "disturbance: expected at least one term"),
    (("design", "disturbance", 0), 3, r"design.disturbance\[0\]: expected a mapping, got 3"),
    (
        ("design", "disturbance", 0, "kind"),
        ...,
        r"design.disturbance\[0\].kind: expected a name, got None",
    ),
    (("design", "disturbance", 0, "kind"), "wind", "disturbance kind: expected one of clean"),
    (("design", "disturbance", 0, "tau"), 1.0, "disturbance bias: unknown parameter 'tau'"),
    (
        ("design", "disturbance", 0, "density"),
        "x",
        r"design.disturbance\[0\].density: expected a number",
    ),
    (("design", "disturbance", 0, "density"), -1.0, "bias density: expected a finite number of"),
    (("design", "uncertainty"), 3, "design.uncertainty: expected a mapping, got 3"),
    (("design", "uncertainty", "stiffness"), "x", "design.uncertainty.stiffness: expected a numb"),
    (("design", "uncertainty", "stiffness"), -0.1, "uncertainty stiffness: expected a finite numb"),
    (("design", "uncertainty", "wind"), 0.1, "uncertain parameter: expected one of stiffness"),
    (("design", "certify_uncertainty"), 1, "design.certify_uncertainty: expected true or false"),
    (("design", "certify_uncertainty"), True, "certify_uncertainty: expected at least one unc"),
    (("gain", "L"), 3.0, "gain: unknown entry 'L', expected some of K"),
    (("certificate", "Q"), 3.0, "certificate: unknown entry 'Q', expected some of P"),
    (("solver", "name"), [1], r"solver.name: expected text, got \[1\]"),
    (("gain",), ..., "gain: expected a mapping, got None"),
    (("gain", "K"), ..., "gain.K: expected a list of 5, got None"),
    (("gain", "K"), [1.0] * 4, "gain.K: expected a list of 5, got 4"),
    (("gain", "K", 1), [1.0], r"gain.K\[1\]: expected a number, got \[1.0\]"),
    (("gain", "K", 1), math.nan, r"gain.K\[1\]: expected a finite number, got nan"),
    (("certificate",), 3, "certificate: expected a mapping, got 3"),
    (("certificate", "P"), ..., "certificate.P: expected a list of 5, got None"),
    (("certificate", "P", 4), ..., "certificate.P: expected a list of 5, got 4"),
    (("certificate", "P", 1), [1.0], r"certificate.P\[1\]: expected a list of 5, got 1"),
    (("certificate", "P", 1, 2), "x", r"certificate.P\[1\]\[2\]: expected a number, got 'x'"),
    (("certificate", "P", 1, 2), math.inf, r"certificate.P\[1\]\[2\]: expected a finite number"),
    (("solver",), ..., "solver: expected a mapping, got None"),
    (("solver", "luck"), 1, "solver: unknown entry 'luck', expected some of name, version"),
    (("solver", "iterations"), "many", "solver.iterations: expected a number, got 'many'"),
]


@pytest.mark.parametrize(("place", "value", "message"), MALFORMED)
def test_a_malformed_entry_is_named_with_the_file(
    valid: dict[str, Any], place: tuple[Any, ...], value: Any, message: str, tmp_path: Path
) -> None:
    path = written(tmp_path, changed(valid, place, value))
    with pytest.raises(DesignFileError, match=rf"my\.yaml: {message}") as caught:
        load_design(path)
    assert not isinstance(caught.value, CertificateError)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("gain", "K", 0), 0.0),
        (("certificate", "P", 0, 0), 97000.0),
        (("design", "x_max"), 0.8),
        (("design", "arm", "stiffness"), 12.0),
        (("design", "disturbance", 0, "density"), 2e-4),
    ],
)
def test_an_edited_design_is_refused_by_its_certificate(
    valid: dict[str, Any], place: tuple[Any, ...], value: float, tmp_path: Path
) -> None:
    path = written(tmp_path, changed(valid, place, value))
    with pytest.raises(
        CertificateError, match=r"my\.yaml: the certificate does not hold: .*margin"
    ):
        load_design(path)
    assert not parse_design(path).certificate.holds


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("design", "measurement_std"), 1e200),
        (("design", "initial_std", 0), 1e200),
        (("design", "rate"), 1e-3),
        (("design", "arm"), {"link_inertia": 1e-200, "motor_inertia": 1e-200}),
        (("design", "arm"), {"stiffness": 1e150}),
        (("design", "arm"), {"link_damping": 1e5}),
        (("design", "process_noise"), {"link": 1e308}),
        (("design", "disturbance"), [{"kind": "gauss_markov", "time_constant": 1e-300}]),
        (("design", "disturbance"), [{"kind": "bias", "density": 1e308}]),
        (("design", "disturbance"), [{"kind": "arbitrary"}]),
        (("gain", "K"), [1e200] * 5),
        (("gain", "K"), [1e308] * 5),
        (("certificate", "P", 4, 4), 0.0),
    ],
)
def test_extreme_entries_are_refused_by_name(
    valid: dict[str, Any], place: tuple[Any, ...], value: Any, tmp_path: Path
) -> None:
    with pytest.raises(DesignFileError, match=r"my\.yaml: "):
        load_design(written(tmp_path, changed(valid, place, value)))


def test_a_clean_design_is_not_one_for_an_arbitrary_disturbance(tmp_path: Path) -> None:
    """The same matrices with the same state count, and no proof."""
    clean = synthesise(ArmRequest(disturbance=(DisturbanceTerm("clean"),)))
    request = replace(clean.request, disturbance=(DisturbanceTerm("arbitrary"),))
    path = tmp_path / "my.yaml"
    save_design(replace(clean, request=request), path)
    with pytest.raises(CertificateError, match="disturbance has a model: DOES NOT HOLD"):
        load_design(path)


@pytest.mark.parametrize("place", ["rate: {}", "format: {}", "design: {{rate: {}}}"])
def test_an_integer_too_long_to_print_is_refused(place: str, tmp_path: Path) -> None:
    path = written(tmp_path, place.format("0x" + "f" * 6000))
    with pytest.raises(DesignFileError, match=r"my\.yaml: "):
        load_request(path) if "rate" in place else load_design(path)


@pytest.mark.parametrize("place", ["format: ", "solver: ", "rate: ", "version: "])
def test_an_alias_bomb_is_not_written_out(place: str, tmp_path: Path) -> None:
    """10^30 elements: this must return at once; with repr() it never returns."""
    lines = ["a0: &a0 [" + "x, " * 9 + "x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 30)]
    path = written(tmp_path, "\n".join([*lines, f"{place}*a29"]))
    with pytest.raises(DesignFileError, match=r"my\.yaml: "):
        load_design(path)


@pytest.mark.parametrize(
    "text",
    [
        "disturbance: [{kind: bias, density: -1}]",
        "arm: {link_inertia: 1.0e-200, motor_inertia: 1.0e-200}",
        "arm: {stiffness: 1.0e+100}",
    ],
)
def test_a_request_that_makes_no_model_is_refused_when_read(text: str, tmp_path: Path) -> None:
    with pytest.raises(DesignFileError, match=r"my\.yaml: "):
        load_request(written(tmp_path, text))


def test_numpy_numbers_are_saved_as_numbers(shipped: Design, tmp_path: Path) -> None:
    terms = (DisturbanceTerm("bias", {"density": np.float64(1e-4)}),)
    noise = ProcessNoise(np.float64(1e-4), np.float64(1e-5))
    request = replace(
        shipped.request, x_max=np.float64(0.75), rate=200, disturbance=terms, process_noise=noise
    )
    save_design(replace(shipped, request=request), tmp_path / "a.yaml")
    assert load_design(tmp_path / "a.yaml").request == shipped.request


def test_a_missing_file_is_said_to_be_missing(tmp_path: Path) -> None:
    for load in (load_design, load_request):
        with pytest.raises(DesignFileError, match=r"nothing\.yaml: no such design file"):
            load(tmp_path / "nothing.yaml")


def test_a_folder_is_no_design_file(tmp_path: Path) -> None:
    with pytest.raises(DesignFileError, match="cannot read the design file: Is a directory"):
        load_design(tmp_path)


def test_a_huge_file_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "my.yaml"
    with path.open("wb") as file:
        file.truncate(1 << 33)
    with pytest.raises(DesignFileError, match="larger than 1048576 bytes, not a design file"):
        load_design(path)


BOMB = "\n".join(
    ["a: &a [x, x, x, x, x, x, x, x, x]"]
    + [
        f"{b}: &{b} [{', '.join(['*' + a] * 9)}]"
        for a, b in zip("abcdefghi", "bcdefghij", strict=True)
    ]
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected a mapping, got NoneType"),
        ("[1, 2]", "expected a mapping, got list"),
        ("just words", "expected a mapping, got str"),
        ("&a [*a]", "not valid YAML: line 1: aliases"),
        ("a: [", "not valid YAML"),
        ("a: b: c", "not valid YAML"),
        ("\tx: 1", "not valid YAML"),
        ("? [1, 2]\n: 3", "not valid YAML"),
        ("a: *nobody", "not valid YAML"),
        ("a: 1\x00", "not valid YAML"),
        ("a: 2024-99-99", "not valid YAML"),
        ("--- {}\n--- {}", "not valid YAML"),
        ("!!python/object/apply:os.system ['exit 1']", "not valid YAML.*python/object/apply"),
        ("design: !!python/name:os.system", "not valid YAML.*python/name"),
        ("design: !!python/object/new:type [x, [], {}]", "not valid YAML.*python/object/new"),
        ("[" * 20_000, "not valid YAML"),
        ("{a: " * 20_000, "not valid YAML"),
        ("- " * 20_000, "not valid YAML"),
        (BOMB, "not valid YAML: line 2: aliases"),
        ("<<: &a {<<: *a}", "format: expected|not valid YAML"),
    ],
    ids=lambda text: repr(text[:24]),
)
def test_hostile_text_is_refused_with_the_file_named(
    text: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(DesignFileError, match=rf"my\.yaml: (?s:{message})"):
        load_design(written(tmp_path, text))


@pytest.mark.parametrize("data", [b"\xff\xfe\x00\x01", b"\x80", bytes(range(256))])
def test_bytes_that_are_no_text_are_refused(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "my.yaml"
    path.write_bytes(data)
    with pytest.raises(DesignFileError, match=r"my\.yaml: not valid YAML"):
        load_design(path)


def places(data: Any, prefix: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the place of every entry of nested mappings and lists."""
    items = data.items() if isinstance(data, dict) else enumerate(data)
    for key, value in items:
        yield (*prefix, key)
        if isinstance(value, dict | list):
            yield from places(value, (*prefix, key))


def entry_at(data: Any, place: tuple[Any, ...]) -> Any:
    for key in place:
        data = data[key]
    return data


def loaded(path: Path) -> Design | str:
    """Return the design a file holds, or the text of its refusal; any other error gets out."""
    try:
        return load_design(path)
    except DesignFileError as error:
        return str(error)


WRONG = st.recursive(
    st.one_of(
        st.none(), st.booleans(), st.integers(), st.floats(), st.just(10**400),
        st.text("abc: 1.-", max_size=8), st.dates(), st.binary(max_size=4),
    ),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text("ab", max_size=2), inner),
    max_leaves=6,
)  # fmt: skip


@settings(PROPERTY, max_examples=300)
@given(data=st.data())
def test_a_mutated_file_is_either_a_design_or_a_named_refusal(
    valid: dict[str, Any], data: st.DataObject, tmp_path: Path
) -> None:
    """Entries replaced by other types, removed, or set beside the known ones."""
    place = data.draw(st.sampled_from(list(places(valid))))
    kind = data.draw(st.sampled_from(["replace", "remove", "add"]))
    if kind == "add":
        place = (*place[:-1], data.draw(st.text("ab", max_size=2)))
    parent: Any = valid
    for key in place[:-1]:
        parent = parent[key]
    if kind == "add" and isinstance(parent, list):
        place = (*place[:-1], 0)
    path = written(tmp_path, changed(valid, place, ... if kind == "remove" else data.draw(WRONG)))
    outcome = loaded(path)
    if isinstance(outcome, Design):
        assert outcome.certificate.holds
    else:
        assert outcome.startswith(f"{path}: ")


@settings(PROPERTY, max_examples=300)
@given(data=st.data())
def test_any_numbers_are_either_a_design_or_a_named_refusal(
    valid: dict[str, Any], data: st.DataObject, tmp_path: Path
) -> None:
    """One number or several set to any other that a file can hold, however large or small."""
    numeric = [place for place in places(valid) if isinstance(entry_at(valid, place), float)]
    edited = valid
    for place in data.draw(st.lists(st.sampled_from(numeric), min_size=1, max_size=3)):
        edited = changed(edited, place, data.draw(st.floats()))
    outcome = loaded(written(tmp_path, edited))
    if isinstance(outcome, Design):
        assert outcome.certificate.holds


@settings(PROPERTY, max_examples=150)
@given(cut=st.floats(0.0, 1.0))
def test_a_truncated_file_is_either_a_design_or_a_named_refusal(
    shipped: Design, shipped_file: Path, cut: float, tmp_path: Path
) -> None:
    text = shipped_file.read_text(encoding="utf-8")
    path = written(tmp_path, text[: int(cut * len(text))])
    outcome = loaded(path)
    if isinstance(outcome, Design):
        # Only the solver's report, which proves nothing, may be incomplete.
        assert (outcome.P == shipped.P).all()
        assert (outcome.K == shipped.K).all()
    else:
        assert outcome.startswith(f"{path}: ")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"P": np.eye(4)}, r"P: expected shape \(5, 5\), got \(4, 4\)"),
        ({"K": np.zeros(5)}, r"K: expected shape \(5, 1\), got \(5,\)"),
        ({"P": np.full((5, 5), math.nan)}, "P: every entry must be finite"),
    ],
)
def test_a_design_has_matrices_of_the_right_shape(
    shipped: Design, change: dict[str, Any], message: str
) -> None:
    with pytest.raises(ModelError, match=message):
        replace(shipped, **change)


@pytest.mark.parametrize("P", [-np.eye(5), np.zeros((5, 5)), np.ones((5, 5))])
def test_a_matrix_that_is_no_bound_has_no_covariance(shipped: Design, P: Any) -> None:
    with pytest.raises(ModelError, match="P: expected a positive definite matrix"):
        _ = replace(shipped, P=P).covariance_bound
