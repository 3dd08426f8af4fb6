// Speed at which overlaps are undone at most [m/s]; see coulomb.py.
#pragma once

constexpr double FASTEST = 0.1;
