"""Names of files and columns in OVAD's layout, shared by reader and simulator."""

LOG_NAME = "DataLog.csv"
AUDIO_NAME = "out_multi.wav"
ARRAY_NAME = "array.xml"  # Not of OVAD itself: the array of a data set, in its root
# The data set's description names the first, its authors' code opens the second.
DETECTION_NAMES = ("camera_baseline_results.json", "camera_baseline_detections.json")
# Beside a simulated recording only.
TRUTH_NAME = "truth.json"
COLUMNS = ("ID", "Environment", "Class", "T0")
FRAME_RATE_HZ = 10.0
