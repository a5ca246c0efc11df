"""Light transport: emission, scattering, connection to the sensor, splatting, and the loops that combine them."""
