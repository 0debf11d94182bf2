//! Driver of the stspp 3D sensor.
