# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The claims of the method's paper, each judged by a number that is computed here.

The verdicts are not written down: each follows from its number by a stated limit, so a change of
the code that reversed one would reverse the table, and fail the test that is named.
"""

import enum
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.paper import examples
from tsobs_ros.paper.analysis import (
    check_autonomous_innovation,
    check_matching,
    check_stability,
    uncertainty_factor,
)
from tsobs_ros.paper.augmentation import Augmentation, Conditions, check_conditions
from tsobs_ros.paper.examples import PaperExample
from tsobs_ros.paper.runs import SETTLED, ArmComparison, ExampleRun

_ANALYSIS = "test/paper/test_analysis.py::"
_EXAMPLES = "test/paper/test_examples.py::"
_DESIGN = "test/paper/test_synthesis.py::"
_OBSERVER = "test/paper/test_observer.py::"
_PAGE = "test/paper/test_page.py::"

ROUNDING = 1e-3
"""‖P M − C̄ᵀ‖ that four printed decimals can leave."""


class Verdict(enum.Enum):
    """The verdict on a claim."""

    HOLDS = "holds"
    HOLDS_ONLY_IF = "holds only if"
    DOES_NOT_HOLD = "does not hold"


@dataclass(frozen=True)
class Claim:
    """A claim and its verdict.

    Attributes:
        claim: One sentence.
        verdict: Decided by `number`.
        condition: The condition of `HOLDS_ONLY_IF`; else a reason, or nothing.
        number: What was measured, as text with its unit.
        test: The test that shows it, as pytest takes it.
    """

    claim: str
    verdict: Verdict
    condition: str
    number: str
    test: str

    @property
    def judgement(self) -> str:
        """Verdict and condition as one phrase."""
        if self.verdict is Verdict.HOLDS_ONLY_IF:
            return f"{self.verdict.value} {self.condition}"
        return f"{self.verdict.value}: {self.condition}" if self.condition else self.verdict.value

    def as_mapping(self) -> dict[str, Any]:
        """Return the claim as plain data."""
        return {**vars(self), "verdict": self.verdict.value}

    def __str__(self) -> str:
        detail = f"{self.condition}; {self.number}" if self.condition else self.number
        return f"{self.verdict.value.upper():<15}{self.claim}\n{'':<17}{detail}"


def judge(runs: Mapping[str, ExampleRun], comparison: ArmComparison) -> list[Claim]:
    """Return the table of claims.

    Args:
        runs: Of Examples 1 and 2, by name.
        comparison: Example 3 by every observer.
    """
    return [
        *_printed_claims(),
        *_design_claims(runs),
        *_convergence_claims(runs),
        *_structure_claims(runs),
        *_arm_claims(comparison),
    ]


def check_printed_p(example: PaperExample) -> Conditions:
    """Return (18) on {C̄x̄ = 0}, (19) and (38) with the printed P and M of Example 1."""
    aug = Augmentation(example.system)
    return check_conditions(
        aug,
        examples.EXAMPLE_1_P,
        alpha_1=aug.alpha_1(example.alpha),
        M=examples.EXAMPLE_1_M,
        epsilon=aug.min_epsilon(example.alpha, example.xi),
        rounding=ROUNDING,
    )


def check_printed_gains(example: PaperExample) -> list[Conditions]:
    """Return (37) with the printed P and H of Example 3, for each reading of them.

    There is one for each change of sign of P's coordinates, each of H's, and H as Hᵢ or E_L⁻¹Hᵢ.
    """
    aug, signs = Augmentation(example.system), examples.sign_changes(4)
    gains = [change[:, np.newaxis] * examples.EXAMPLE_3_H for change in signs]
    gains += [aug.E_L_inverse @ each for each in gains]
    matrices = [change[:, np.newaxis] * examples.EXAMPLE_3_P * change for change in signs]
    return [check_conditions(aug, P, alpha_1=np.zeros(2), H1=H1) for P in matrices for H1 in gains]


def _printed_claims() -> list[Claim]:
    first = check_printed_p(examples.example_1())
    matching, norm = first["(19)"], first["(38)"]
    rules = [first["(37) rule 1"], first["(37) rule 2"]]
    return [
        Claim(
            "Example 1: the printed M is P⁻¹C̄ᵀ of the printed P (19).",
            _verdict(matching.holds),
            "to the printed digits, signs restored",
            f"‖P M − C̄ᵀ‖ = {matching.number:.1e}",
            _EXAMPLES + "test_printed_matching_matrix_fits_to_rounding",
        ),
        Claim(
            "Example 1: the printed P satisfies (18) for both rules.",
            _verdict(all(rule.holds for rule in rules)),
            "rule 1 does, rule 2 does not, whatever Q₂ is",
            "largest eigenvalues on C̄x̄ = 0: " + ", ".join(f"{rule.number:+.3f}" for rule in rules),
            _EXAMPLES + "test_printed_p_fails_rule_2_for_every_reading_of_its_signs",
        ),
        Claim(
            "Example 1: the printed P has ‖P⁻¹‖ ≥ ε (38).",
            _verdict(norm.holds),
            "as recomputed; by its own digits it just misses, but P may be scaled at will",
            f"‖P⁻¹‖ = {norm.number:.4f} (printed {examples.EXAMPLE_1_INVERSE_NORM}), "
            f"ε = {norm.limit:.4f} (printed {examples.EXAMPLE_1_EPSILON})",
            _DESIGN + "test_scaling_meets_any_epsilon",
        ),
    ]


def _design_claims(runs: Mapping[str, ExampleRun]) -> list[Claim]:
    third = examples.example_3()
    proof, reason = check_stability(third.system.A, third.alpha)
    designs = [run.design for run in runs.values()]
    seconds = max(design.seconds for design in designs)
    factors = [uncertainty_factor(design.P) for design in designs]
    return [
        Claim(
            "Examples 1 and 2: the LMIs (37) have a solution.",
            _verdict(not any(design.conditions.failing for design in designs)),
            "re-checked by eigenvalues",
            f"solved in {seconds:.2f} s or less; ε accepted at step "
            + ", ".join(str(design.steps) for design in designs),
            _DESIGN + "test_examples_are_designed_and_hold_on_rechecking",
        ),
        Claim(
            "Example 3: the LMIs (37) have a solution.",
            _verdict(proof.P is not None),
            reason,
            f"dual proof: Z ⪰ 0, tr Z = 1, smallest eigenvalue of A Z + Z Aᵀ {proof.margin:.0e}",
            _DESIGN + "test_undamped_arm_is_refused_with_its_mode",
        ),
        Claim(
            "(18) bounds the uncertainty: eᵀPΔA e ≤ α eᵀPe.",
            _verdict(max(factors) <= 1.0 + 1e-9, otherwise=Verdict.HOLDS_ONLY_IF),
            "α is multiplied by (√c + 1/√c)/2, c = cond(P)",
            f"factor {_list(factors, '.3f')} for our P of Examples 1, 2; "
            f"{uncertainty_factor(examples.EXAMPLE_1_P):.2f} for the printed one",
            _ANALYSIS + "test_uncertainty_factor_is_attained_and_never_exceeded",
        ),
    ]


def _convergence_claims(runs: Mapping[str, ExampleRun]) -> list[Claim]:
    exact = [float(run.settled_error("adaptive", 0).max()) for run in runs.values()]
    uncertain = [run.settled_rms("adaptive", 1) for run in runs.values()]
    fixed = [run.settled_rms("fixed", 1) for run in runs.values()]
    change = max(float(np.abs(a / b - 1.0).max()) for a, b in zip(uncertain, fixed, strict=True))
    energies = [run.lyapunov("adaptive")[:, 0] for run in runs.values()]
    rise = max(float(max(0.0, np.diff(V).max()) / V[0]) for V in energies)
    return [
        Claim(
            "Without uncertainty (λ = 0), V decreases.",
            _verdict(rise < 1e-6),
            "",
            f"largest rise in a step {_tiny(rise)} of V(0)",
            _PAGE + "test_lyapunov_function_falls_without_uncertainty",
        ),
        Claim(
            "Without uncertainty, state and disturbance errors vanish.",
            Verdict.HOLDS_ONLY_IF if max(exact) < 1e-3 else Verdict.DOES_NOT_HOLD,
            "every Aᵢ is stable, with one Lyapunov matrix (Proposition 2)",
            "largest error from 10 s on, Examples 1, 2: " + _list(exact, ".1e"),
            _PAGE + "test_errors_vanish_without_uncertainty",
        ),
        Claim(
            "With the printed ΔA (λ = 1), the errors vanish, too.",
            _verdict(max(float(each.max()) for each in uncertain) < 1e-3),
            "they settle at a level that adaptation does not change",
            "RMS of x − x̂ from 10 s on: "
            + "; ".join(_list(each, ".4f", " / ") for each in uncertain)
            + f"; without adaptation within {100.0 * change:.0f} %",
            _PAGE + "test_errors_do_not_vanish_with_uncertainty",
        ),
    ]


def _structure_claims(runs: Mapping[str, ExampleRun]) -> list[Claim]:
    final = runs["example_1"].adaptation("adaptive")[-1]
    moved = max(run.difference("noise_fed") for run in runs.values())
    late = max(run.difference("model_only", SETTLED) for run in runs.values())
    silent = max(float(run.adaptation("consistent").max()) for run in runs.values())
    drive = max(
        check_autonomous_innovation(run.design.augmentation).number for run in runs.values()
    )
    matching = [
        check_matching(run.design.augmentation, run.design.P, run.example.delta_A)
        for run in runs.values()
    ]
    return [
        Claim(
            "The output error y − ŷ corrects the state estimate.",
            _verdict(drive > 1e-10),
            "the innovation is autonomous (Proposition 1)",
            f"relative gain from the plant to e_y: {_tiny(drive)}",
            _ANALYSIS + "test_innovation_is_autonomous_for_every_l",
        ),
        Claim(
            "The state estimate depends on the measurement.",
            _verdict(moved >= 1e-10, otherwise=Verdict.HOLDS_ONLY_IF),
            "its premise z = y₁ does: with z given, y may be replaced by noise",
            f"x̂ changes by {moved:.0e} (Examples 1 and 2, no adaptation); from 10 s on it is "
            f"the open-loop model to {late:.0e}",
            _OBSERVER + "test_estimate_is_the_same_from_noise",
        ),
        Claim(
            "Some Ξᵢ ≠ 0 satisfies the matching assumption (15).",
            _verdict(any(not each.holds for each in matching)),
            "only ΔA = 0 does (Proposition 3)",
            f"the best Ξ leaves {min(each.number for each in matching):.0%} of ΔA over",
            _ANALYSIS + "test_matching_leaves_all_of_the_uncertainty",
        ),
        Claim(
            "The adaptive law estimates the uncertainty.",
            _verdict(silent > 1e-10),
            "it integrates what is left of the observer's own start",
            f"started at ω̂(0) = y(0) − C x̂(0), ‖Ξ̂‖ stays at {silent:.0e}; at x̂̄(0) = 0 it moves to "
            f"{final[0]:.4f} at λ = 0 and to {final[1]:.4f} at λ = 1",
            _OBSERVER + "test_adaptation_never_starts_from_a_fitting_estimate",
        ),
    ]


def _arm_claims(comparison: ArmComparison) -> list[Claim]:
    x3, readings = comparison.motor_angle, check_printed_gains(examples.example_3())
    high_gain, seeds = min(x3["PO"], x3["PIO"]), len(comparison.observers["PO"].rmse)
    least = min(max(one[f"(37) rule {rule}"].number for rule in (1, 2)) for one in readings)
    return [
        Claim(
            "Example 3: the printed P and H satisfy (37).",
            _verdict(not all(one.failing for one in readings)),
            f"in none of {len(readings)} readings: signs of P, of H; H as Hᵢ or E_L⁻¹Hᵢ",
            f"largest eigenvalue at least {least:+.1f}, must be negative",
            _EXAMPLES + "test_printed_solution_of_example_3_fails_for_every_sign",
        ),
        Claim(
            "Example 3: the method's x₃ is better than that of PO and PIO.",
            _verdict(x3["paper"] < high_gain),
            "",
            f"mean RMSE of x₃ over {seeds} runs: "
            + ", ".join(f"{name} {value:.3g}" for name, value in x3.items()),
            _PAGE + "test_printed_gains_lose_to_every_other_observer",
        ),
        Claim(
            "Example 3: an observer with a disturbance model beats PO and PIO on x₃.",
            _verdict(x3["ours"] < high_gain),
            "the certified T–S observer, with a bias as its disturbance model",
            f"{x3['ours']:.4f} against {x3['PO']:.4f} and {x3['PIO']:.4f} at their best θ",
            _PAGE + "test_certified_observer_beats_high_gain_observers",
        ),
    ]


def _verdict(holds: bool, otherwise: Verdict = Verdict.DOES_NOT_HOLD) -> Verdict:
    return Verdict.HOLDS if holds else otherwise


def _list(values: Sequence[float] | Array, style: str, separator: str = ", ") -> str:
    return separator.join(f"{value:{style}}" for value in values)


def _tiny(value: float) -> str:
    return f"{value:.0e}" if value else "0"
