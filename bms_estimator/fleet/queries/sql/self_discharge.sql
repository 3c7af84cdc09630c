-- Series cells with a significant self-discharge, as the worker has estimated it at the end of the last hour of a pack in the
-- recent days. Needs: hours, packs.
WITH last_hours AS (
    SELECT pack, max_by(hours, hour) AS h
    FROM hours
    WHERE self_discharge_a IS NOT NULL AND hour // 24 > $today - $recent_days
    GROUP BY pack
)
SELECT
    type, pack, h.self_discharge_cell AS cell, 1000 * h.self_discharge_a AS self_discharge_ma,
    1000 * h.self_discharge_std_a AS self_discharge_std_ma, h.self_discharge_a / h.self_discharge_std_a AS stds,
    2400 * h.self_discharge_a / h.capacity_ah AS percent_per_day
FROM last_hours JOIN packs USING (pack)
WHERE h.self_discharge_a > $self_discharge_c * h.capacity_ah AND h.self_discharge_a > $stds * h.self_discharge_std_a
ORDER BY percent_per_day DESC, pack
