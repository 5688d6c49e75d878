# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `tsobs` command: a thin layer of words over the package's functions.

Exit codes: 0 done, 1 it failed (one line on stderr says why), 2 wrong usage.
"""

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from tsobs_ros import __version__
from tsobs_ros.errors import TsobsError


def main(argv: Sequence[str] | None = None) -> int:
    """Run `tsobs` with the given arguments, `sys.argv` by default; return the exit code."""
    options = _parser().parse_args(argv)
    command: Callable[[argparse.Namespace], int] = options.command
    try:
        return command(options)
    except TsobsError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        extra = {
            "cvxpy": "design",
            "clarabel": "design",
            "matplotlib": "report",
            "plotly": "report",
            "tqdm": "report",
            "mcap_ros2": "report",
        }.get(missing)
        if extra is None:
            raise
        print(
            f"error: {missing} is not installed; pip install 'tsobs_ros[{extra}]'", file=sys.stderr
        )
        return 1
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 1
    except BrokenPipeError:
        # The reader of our output has gone; flushing at exit would fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="tsobs",
        description="State and sensor-disturbance estimation for an arm with an elastic joint.",
    )
    parser.add_argument("--version", action="version", version=f"tsobs {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    demo = commands.add_parser("demo", help="simulate, observe, record and report, over ROS")
    demo.add_argument("--output", type=Path, help="folder to make (default: demo/<date and time>)")
    demo.add_argument("--duration", type=_positive, default=20.0, metavar="S")
    demo.add_argument("--seed", type=int, default=1)
    demo.add_argument("--bias", type=float, default=0.1, metavar="RAD", help="size of the step")
    demo.add_argument("--bias-at", type=_positive, default=8.0, metavar="S")
    demo.add_argument("--design", type=Path, metavar="FILE", help="design of the observer")
    demo.add_argument(
        "--domain-id",
        type=int,
        default=None,
        metavar="N",
        help="ROS domain (default: one of its own, so that nothing else is disturbed)",
    )
    demo.add_argument("--json", action="store_true", help="print the report as JSON")
    demo.set_defaults(command=_demo)

    design = commands.add_parser("design", help="design a certified gain and write its file")
    design.add_argument(
        "request", type=Path, nargs="?", help="YAML with the arm, noise and domain; else defaults"
    )
    design.add_argument("--output", type=Path, required=True, metavar="FILE")
    design.add_argument("--force", action="store_true", help="replace an existing file")
    design.add_argument("--json", action="store_true", help="print the result as JSON")
    design.set_defaults(command=_design)

    verify = commands.add_parser("verify", help="re-check the certificate of a design file")
    verify.add_argument("design", type=Path, nargs="?", help="default: the shipped design")
    verify.add_argument("--json", action="store_true", help="print the margins as JSON")
    verify.set_defaults(command=_verify)

    report = commands.add_parser("report", help="table and figures of a recorded run")
    report.add_argument("bag", type=Path)
    report.add_argument("--output", type=Path, help="folder for the report (default: by the bag)")
    report.add_argument("--design", type=Path, metavar="FILE", help="default: the shipped design")
    report.add_argument("--no-ekf", action="store_true", help="leave out the EKF comparison")
    report.add_argument("--json", action="store_true", help="print the report as JSON")
    report.set_defaults(command=_report)
    return parser


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a number above 0, got {text}")
    return value


def _demo(options: argparse.Namespace) -> int:
    from tqdm import tqdm

    from tsobs_ros.demo import DemoOptions, run_demo

    output = options.output or Path("demo") / datetime.now().strftime("%Y_%m_%d-%H_%M_%S")
    # Any domain from 1 to 101 keeps clear of the ports that outgoing connections use.
    domain = 1 + os.getpid() % 101 if options.domain_id is None else options.domain_id
    settings = DemoOptions(
        duration=options.duration,
        seed=options.seed,
        bias=options.bias,
        bias_at=options.bias_at,
        domain_id=domain,
        design=options.design,
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
    return _print_report(bag, output, options.design, ekf=True, as_json=options.json)


def _report(options: argparse.Namespace) -> int:
    folder = options.output or options.bag.parent
    return _print_report(
        options.bag, folder, options.design, ekf=not options.no_ekf, as_json=options.json
    )


def _print_report(
    bag: Path, output: Path, design_path: Path | None, *, ekf: bool, as_json: bool
) -> int:
    from tsobs_ros.design.file import load_design
    from tsobs_ros.report.bag_report import make_bag_report

    report = make_bag_report(bag, output, load_design(_design_path(design_path)), ekf=ekf)
    _show(report.as_mapping(), report.text(), as_json)
    return 0


def _design(options: argparse.Namespace) -> int:
    from tsobs_ros.design.file import load_request, save_design
    from tsobs_ros.design.request import DesignRequest
    from tsobs_ros.design.synthesis import synthesise
    from tsobs_ros.errors import DesignFileError

    if options.output.exists() and not options.force:
        raise DesignFileError(f"{options.output}: exists already; --force replaces it")
    request = load_request(options.request) if options.request else DesignRequest()
    design = synthesise(request)
    save_design(design, options.output)
    _show(
        {"design": str(options.output), **_summary(design)},
        f"{_summary_text(design)}\nwritten to {options.output}",
        options.json,
    )
    return 0


def _verify(options: argparse.Namespace) -> int:
    from tsobs_ros.design.file import parse_design

    path = _design_path(options.design)
    design = parse_design(path)
    report = design.certificate
    verdict = "the certificate holds" if report.holds else "THE CERTIFICATE DOES NOT HOLD"
    _show(
        {"design": str(path), **_summary(design)},
        f"{path}\n{_summary_text(design)}\n{verdict}",
        options.json,
    )
    return 0 if report.holds else 1


def _design_path(path: Path | None) -> Path:
    from tsobs_ros.resources import config_path

    return config_path("elastic_joint.design.yaml") if path is None else path


def _summary(design: Any) -> dict[str, Any]:
    report = design.certificate
    return {
        "holds": report.holds,
        "inequalities": [
            {
                "name": inequality.name,
                "where": inequality.where,
                "margin": inequality.margin,
                "holds": inequality.holds,
            }
            for inequality in report.inequalities
        ],
        "contraction_rate": report.contraction_rate,
        "gain": design.K[:, 0].tolist(),
        "bound_std": design.bound_std.tolist() if report.holds else None,
        "disturbance": design.request.disturbance_model.label,
        "x_max": design.request.x_max,
        "rate": design.request.rate,
        "solver": f"{design.solver.name} {design.solver.version}",
        "solver_status": design.solver.status,
    }


def _summary_text(design: Any) -> str:
    request, report = design.request, design.certificate
    lines = [
        f"disturbance {request.disturbance_model.label}, |q1| <= {request.x_max:.4g} rad, "
        f"{request.rate:g} Hz; {design.solver.name} {design.solver.version}: "
        f"{design.solver.status}",
        *(f"  {inequality}" for inequality in report.inequalities),
    ]
    if report.holds:
        names = ["link angle [rad]", "link velocity [rad/s]", "motor angle [rad]"]
        names += ["motor velocity [rad/s]"]
        names += [f"disturbance state {i + 1}" for i in range(design.K.shape[0] - 4)]
        lines.append("certified 1-sigma bounds before a sample:")
        lines += [
            f"  {name:<24}{bound:.5f}" for name, bound in zip(names, design.bound_std, strict=True)
        ]
    return "\n".join(lines)


def _show(mapping: dict[str, Any], text: str, as_json: bool) -> None:
    print(json.dumps(mapping, indent=2) if as_json else text)


if __name__ == "__main__":
    sys.exit(main())
