"""Light transport: emission, scattering, connection to the sensor, splatting, and the one loop that joins them."""
