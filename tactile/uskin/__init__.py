"""XELA uSkin XR1944: 4 x 4 taxels of three axes on each finger, on a CAN bus of their own."""
