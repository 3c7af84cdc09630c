-- Packs whose series cells differ in the recent days, and the change of this difference over all days. Needs: hours, packs.
WITH spreads AS (
    SELECT pack, hour // 24 AS day, avg(cell_soc_spread) AS spread, arg_max(weakest_cell, hour) AS lowest_cell
    FROM hours WHERE cell_soc_spread IS NOT NULL
    GROUP BY ALL
)
SELECT
    type, pack, arg_max(spread, day) AS soc_spread, arg_max(lowest_cell, day) AS lowest_cell,
    CASE WHEN count(*) >= $min_days THEN 30 * regr_slope(spread, day) END AS soc_spread_per_30_days
FROM spreads JOIN packs USING (pack)
GROUP BY type, pack
HAVING max(day) > $today - $recent_days AND arg_max(spread, day) > $imbalance_soc
ORDER BY arg_max(spread, day) DESC, pack
