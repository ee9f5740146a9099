"""moteus (mjbots): brushless controllers on CAN FD, 1/5 Mbit/s."""
