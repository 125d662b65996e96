"""A field as ``diagnose`` and ``criticise`` write it in JSON."""

from __future__ import annotations

from typing import Any

from virest.diagnosis.field.residual_table import TableFinding
from virest.diagnosis.findings import FieldFinding, HeldOutGain

Json = dict[str, Any]


def field_record(field: FieldFinding | TableFinding, held_out: HeldOutGain, **more: Any) -> Json:
    """What both commands say of a field; more: what only one of them knows."""
    return {
        "covariates": list(field.covariates),
        "kind": field.kind,
        "shape": field.shape,
        "sentence": field.sentence,
        "size": field.size,
        "unit": field.unit,
        "std": field.std,
        "held_out": {
            "metric": held_out.quantity,
            "before": held_out.before,
            "after": held_out.after,
            "gain": held_out.gain,
        },
        "p_value": field.p_value,
        "confounded": list(field.confounded),
        "reasons": field.reasons,
        "next": field.next,
        **more,
    }
