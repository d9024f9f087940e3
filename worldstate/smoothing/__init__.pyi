from .fixed_lag_smoother import FixedLagSmoother as FixedLagSmoother
from .observations import AngularHeight as AngularHeight
from .observations import FirstSight as FirstSight
from .observations import Range as Range
from .observations import SmoothedTrack as SmoothedTrack
from .observations import SmoothingSettings as SmoothingSettings
