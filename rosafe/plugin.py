"""The public interface for authors of plugins, that is, of representations of their own.

Import these names from here, and from no other module of rosafe::

    from rosafe.plugin import FramedStage, Parameter, Representation, frame_parameters

Stability: within one `API_VERSION` these names, their arguments, and what docs/own-representation.md says about them
keep their meaning; new ones may be added. If a name has to change, it remains available for one more release under its
old name, and the log and ``rosafe doctor`` report each plugin that still uses it.

Attributes
----------
API_VERSION : int
    The version of this interface. A plugin that depends on it can compare it with the version it was written for.
"""

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.representation import Derived, Part, Representation
from rosafe.dsp.framing import FramedStage, frame_parameters
from rosafe.dsp.stage import Stage
from rosafe.dsp.variants import variant

API_VERSION = 1

__all__ = [
    "API_VERSION",
    "Derived",
    "FramedStage",
    "Parameter",
    "Part",
    "Representation",
    "Stage",
    "frame_parameters",
    "variant",
]
