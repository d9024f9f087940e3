from .measurement import Approach as Approach
from .measurement import Bearing as Bearing
from .measurement import Look as Look
from .measurement import Measurement as Measurement
from .measurement import Sighting as Sighting
from .protocols import CoEvidenceChannel as CoEvidenceChannel
from .protocols import MeasurementAdapter as MeasurementAdapter
from .sector import Sector as Sector
