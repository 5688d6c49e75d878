# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What each word of the `tsobs` command does; heavy imports wait until they are needed."""

import argparse
import json
import math
import os
import sys
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

from tsobs_ros.errors import DesignFileError
from tsobs_ros.resources import config_path

_SHIPPED = "elastic_joint.design.yaml"
_SHIPPED_ADAPTIVE = "elastic_joint_adaptive.design.yaml"


def demo(options: argparse.Namespace) -> int:
    """Run plant, observer and recorder, then report on their bag."""
    from tqdm import tqdm

    from tsobs_ros.demo import DemoOptions, run_demo

    output = options.output or Path("demo") / datetime.now().strftime("%Y_%m_%d-%H_%M_%S")
    # Any domain from 1 to 101 keeps clear of the ports that outgoing connections use.
    domain = 1 + os.getpid() % 101 if options.domain_id is None else options.domain_id
    differs = options.stiffness != 0.0 or options.gravity != 0.0
    design_path = options.design or config_path(_SHIPPED_ADAPTIVE if differs else _SHIPPED)
    settings = DemoOptions(
        duration=options.duration,
        seed=options.seed,
        bias=options.bias,
        bias_at=options.bias_at,
        stiffness=options.stiffness,
        gravity=options.gravity,
        domain_id=domain,
        design=design_path,
    )
    print(
        f"plant, observer and recorder on ROS_DOMAIN_ID={domain} for {options.duration:g} s",
        file=sys.stderr,
    )
    with tqdm(
        total=options.duration, unit="s", bar_format="{l_bar}{bar}| {n:.1f}/{total:.1f} s"
    ) as bar:

        def show(seconds: float) -> None:
            bar.update(seconds - bar.n)

        bag = run_demo(output, settings, show)
    exit_code = _report_on(bag, output, design_path, ekf=True, as_json=options.json)
    if not options.json:
        print(
            f"\nthe bag is {bag}: ros2 bag play, Foxglove and PlotJuggler open it\n"
            f"the figure is {output / 'report.png'}; {output / 'report.html'} can be zoomed into, "
            "in any browser"
        )
    return exit_code


def report(options: argparse.Namespace) -> int:
    """Report on a recorded run."""
    folder = options.output or options.bag.parent
    design_path = options.design or config_path(_SHIPPED)
    return _report_on(
        options.bag, folder, design_path, ekf=not options.no_ekf, as_json=options.json
    )


def _report_on(bag: Path, output: Path, design_path: Path, *, ekf: bool, as_json: bool) -> int:
    from tsobs_ros.design.file import load_design
    from tsobs_ros.report.bag_report import make_bag_report

    result = make_bag_report(bag, output, load_design(design_path), ekf=ekf)
    _show(result.as_mapping(), result.text(), as_json)
    return 0


def design(options: argparse.Namespace) -> int:
    """Design a gain and write its file."""
    from tsobs_ros.design.file import load_request, save_design
    from tsobs_ros.design.request import DesignRequest
    from tsobs_ros.design.synthesis import synthesise
    from tsobs_ros.design.ts_file import is_ts_file
    from tsobs_ros.design.ts_synthesis import design_ts_file

    if options.output.exists() and not options.force:
        raise DesignFileError(f"{options.output}: exists already; --force replaces it")
    if options.method == "paper":
        return _design_by_the_paper(options)
    if options.request and is_ts_file(options.request):
        ts_result = design_ts_file(options.request, options.output)
        written = f"{ts_result.text()}\nwritten to {options.output}"
        _show({"design": str(options.output), **ts_result.summary()}, written, options.json)
        return 0
    request = load_request(options.request) if options.request else DesignRequest()
    result = synthesise(request)
    save_design(result, options.output)
    _show(
        {"design": str(options.output), **_summary(result)},
        f"{_summary_text(result)}\nwritten to {options.output}",
        options.json,
    )
    return 0


def _design_by_the_paper(options: argparse.Namespace) -> int:
    from tsobs_ros.design.paper_design import design_adaptive_observer
    from tsobs_ros.design.plain import write_yaml
    from tsobs_ros.model import examples

    build = (examples.example_1, examples.example_2, examples.example_3)[options.example - 1]
    example = build()
    result = design_adaptive_observer(
        example.system, example.alpha, example.xi, Gamma=example.Gamma
    )
    conditions = [str(condition) for condition in result.conditions.conditions]
    mapping = {
        "format": "tsobs_ros adaptive observer of the published method",
        "example": options.example,
        "epsilon": result.epsilon,
        "steps": result.steps,
        "P": result.P.tolist(),
        "H1": result.H1.tolist(),
        "M": result.M.tolist(),
        "Gamma": result.Gamma.tolist(),
        "conditions": conditions,
        "solver": asdict(result.solver),
    }
    write_yaml(options.output, "# Made by `tsobs design --method paper`.\n", mapping)
    lines = [f"{example.name}: epsilon {result.epsilon:.6g}, {result.steps} step(s)"]
    lines += [f"  {condition}" for condition in conditions]
    lines += [f"written to {options.output}"]
    _show(mapping, "\n".join(lines), options.json)
    return 0


def verify(options: argparse.Namespace) -> int:
    """Re-check the certificate of a design file."""
    from tsobs_ros.design.file import parse_design
    from tsobs_ros.design.ts_file import is_ts_file, parse_ts_design

    path = options.design or config_path(_SHIPPED)
    if is_ts_file(path):
        if options.exact:
            raise DesignFileError(f"{path}: --exact is for designs of the arm, not of T-S models")
        ts_design = parse_ts_design(path)
        _show({"design": str(path), **ts_design.summary()}, ts_design.text(), options.json)
        return _verdict(path, ts_design.certificate.holds)
    parsed = parse_design(path)
    if options.exact:
        from tsobs_ros.design.exact import verify_exactly

        proof = verify_exactly(parsed)
        _show({"design": str(path), **proof.as_mapping()}, f"{path}\n{proof.text()}", options.json)
        return _verdict(path, proof.holds)
    holds = parsed.certificate.holds
    verdict = "the certificate holds" if holds else "THE CERTIFICATE DOES NOT HOLD"
    _show(
        {"design": str(path), **_summary(parsed)},
        f"{path}\n{_summary_text(parsed)}\n{verdict}",
        options.json,
    )
    return _verdict(path, holds)


def _verdict(path: Path, holds: bool) -> int:
    if not holds:
        print(f"error: {path}: the certificate does not hold", file=sys.stderr)
    return 0 if holds else 1


def paper(options: argparse.Namespace) -> int:
    """Regenerate the published method's figures and the table of its claims."""
    from tsobs_ros.report.paper import make_paper_report

    result = make_paper_report(options.output, progress=True, seeds=options.seeds)
    _show(result.as_mapping(), str(result), options.json)
    return 0


def _summary(result: Any) -> dict[str, Any]:
    certificate = result.certificate
    return {
        "holds": certificate.holds,
        "inequalities": [
            {**inequality._asdict(), "holds": inequality.holds}
            for inequality in certificate.inequalities
        ],
        "contraction_rate": certificate.contraction_rate,
        "gain": result.K[:, 0].tolist(),
        "bound_std": result.bound_std.tolist() if certificate.holds else None,
        "disturbance": result.request.disturbance_model.label,
        "x_max": result.request.x_max,
        "rate": result.request.rate,
        "solver": f"{result.solver.name} {result.solver.version}",
        "solver_status": result.solver.status,
    }


def _summary_text(result: Any) -> str:
    request, certificate = result.request, result.certificate
    lines = [
        f"disturbance {request.disturbance_model.label}, |q1| <= {request.x_max:.4g} rad, "
        f"{request.rate:g} Hz; {result.solver.name} {result.solver.version}: "
        f"{result.solver.status}",
        *(f"  {inequality}" for inequality in certificate.inequalities),
    ]
    if certificate.holds:
        names = ["link angle [rad]", "link velocity [rad/s]", "motor angle [rad]"]
        names += ["motor velocity [rad/s]"]
        names += [f"disturbance state {i + 1}" for i in range(result.K.shape[0] - 4)]
        lines.append("certified 1-sigma bounds before a sample:")
        lines += [
            f"  {name:<24}{bound:.5f}" for name, bound in zip(names, result.bound_std, strict=True)
        ]
    return "\n".join(lines)


def _show(mapping: dict[str, Any], text: str, as_json: bool) -> None:
    print(json.dumps(_plain(mapping), indent=2, allow_nan=False) if as_json else text)


def _plain(value: Any) -> Any:
    """Return the value with null for every number that JSON does not have."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
