"""The shortest method: read the map a fixed time ahead of the aircraft."""

LEAD_S = 0.18


class FixedLead:
    def __init__(self, sprayer):
        self.sprayer = sprayer

    def order(self, seen):
        rate_l_ha = self.sprayer.rate_l_ha(*seen.ahead(LEAD_S))
        return self.sprayer.duties(rate_l_ha, seen.speed_m_s)
