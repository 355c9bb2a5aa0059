"""Three accelerometers as one sensor, in poses whose attitudes nobody knows.

- `found_poses`: poses that were read, or found in a record by their rest
- `triad`: NIST's nine parameters, the corrected output, and the poses
"""
