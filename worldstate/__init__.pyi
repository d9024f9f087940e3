# Verbs first; isort would mix them with the types.
from .adapters.export.dataframe import to_dataframe as to_dataframe
from .adapters.listener import listen as listen
from .adapters.listener import run as run
from .adapters.state_log import read as read
from .operations.corpus.corpus_run import hear as hear

# isort: split
from .abduction.co_evidence import Absent as Absent
from .abduction.co_evidence import Present as Present
from .abduction.co_evidence import Unqueried as Unqueried
from .abduction.evidence import SignatureEvidence as SignatureEvidence
from .adapters.camera.detections import DetectionFrame as DetectionFrame
from .adapters.camera.pinhole import PinholeCamera as PinholeCamera
from .adapters.listener import Listener as Listener
from .adapters.source import ListenSettings as ListenSettings
from .belief.street_model import FilterSettings as FilterSettings
from .core.filter import WorldFilter as WorldFilter
from .frontend.array.microphone_array import MicrophoneArray as MicrophoneArray
from .ground.errors import WorldstateError as WorldstateError
from .ground.values import NotUsable as NotUsable
from .ground.values import nanoseconds as nanoseconds
from .measurement.measurement import Measurement as Measurement
from .measurement.measurement import Sighting as Sighting
from .measurement.odometry import Odometry as Odometry
from .state.context import Context as Context
from .state.world_state import WorldState as WorldState

__version__: str
