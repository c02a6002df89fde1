"""The maximum allowed power flow of a section, with its standard error."""

from __future__ import annotations

from pse_analysis.scoring.transfer_limit.limit import transfer_limit
from pse_analysis.scoring.transfer_limit.params import (
    DESCRIPTION,
    Contingency,
    Criterion,
    TransferLimitParams,
)
from pse_analysis.scoring.transfer_limit.result import TransferLimit
from pse_analysis.scoring.transfer_limit.sampling import SampledLimit, sampled_limit
from pse_analysis.scoring.transfer_limit.sections import BranchEnd, Section, SectionPower

__all__ = [
    "DESCRIPTION",
    "BranchEnd",
    "Contingency",
    "Criterion",
    "SampledLimit",
    "Section",
    "SectionPower",
    "TransferLimit",
    "TransferLimitParams",
    "sampled_limit",
    "transfer_limit",
]
