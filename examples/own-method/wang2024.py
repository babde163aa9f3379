"""The controller of Wang et al. 2024 (Journal of Agricultural Engineering LV:1547).

It polls the position at 5 Hz, needs 0.42 s for its program (the paper's T2), and reads the map
0.71 s ahead, the lag that its compensation took away in the paper's flights. A valve takes its new
duty with its next PWM period. Doses by the measured curve of the valves, where the paper has its
Eq. 2 (`sitl.wang.eq_2_duties`).
"""

from sitl.own_method import Order

POLL_S, PROGRAM_S, LOOK_AHEAD_S = 0.2, 0.42, 0.71


class Wang2024:
    def __init__(self, sprayer):
        self.sprayer, self.next_poll_s = sprayer, 0.0

    def order(self, seen):
        if seen.now_s < self.next_poll_s:
            return None
        self.next_poll_s = seen.now_s + POLL_S
        rate_l_ha = self.sprayer.rate_l_ha(*seen.ahead(LOOK_AHEAD_S))
        duties = self.sprayer.duties(rate_l_ha, seen.speed_m_s)
        return Order(duties=duties, after_s=PROGRAM_S, restart=False)
