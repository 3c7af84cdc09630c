-- Packs whose series cells differ at rest in the recent days, and the change of this difference over all days.
-- Needs: packs, cell_days.
WITH spreads AS (
    SELECT
        pack, day, max(deviation_v) - min(deviation_v) AS spread_v, any_value(soc) AS soc,
        arg_min(cell, deviation_v) AS lowest_cell, arg_max(cell, deviation_v) AS highest_cell
    FROM cell_days GROUP BY pack, day
)
SELECT
    type, pack, arg_max(spread_v, day) AS spread_v, arg_max(lowest_cell, day) AS lowest_cell,
    arg_max(highest_cell, day) AS highest_cell, arg_max(soc, day) AS soc,
    CASE WHEN count(*) >= $min_days THEN 30 * regr_slope(spread_v, day) END AS spread_v_per_30_days
FROM spreads JOIN packs USING (pack)
GROUP BY type, pack
HAVING max(day) > $today - $recent_days AND arg_max(spread_v, day) > $imbalance_v
ORDER BY arg_max(spread_v, day) DESC, pack
