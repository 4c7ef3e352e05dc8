"""The public interface for authors of plugins, which are representations that are not part of rosAFE.

Import these names from here, and from no other module of rosafe::

    from rosafe.plugin import FramedStage, Parameter, Representation, frame_parameters

Stability: within one `API_VERSION` these names, their arguments and their description in docs/own-representation.md do
not change; new names may be added.

Attributes
----------
API_VERSION : int
    The version of this interface. A plugin that depends on it can compare it with the version it was written for.
"""

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.reference import Citation, Reference
from rosafe.declarations.representation import Derived, Part, Representation
from rosafe.dsp.framing import FramedStage, frame_parameters
from rosafe.dsp.stage import Stage
from rosafe.dsp.variants import variant

API_VERSION = 1

__all__ = [
    "API_VERSION",
    "Citation",
    "Derived",
    "FramedStage",
    "Parameter",
    "Part",
    "Reference",
    "Representation",
    "Stage",
    "frame_parameters",
    "variant",
]
