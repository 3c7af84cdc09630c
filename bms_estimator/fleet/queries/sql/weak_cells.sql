-- Packs in which one series cell has the lowest mean voltage in most hours of the recent days. Needs: hours, packs.
WITH recent AS (
    SELECT * FROM hours
    WHERE weakest_cell IS NOT NULL AND hour // 24 > $today - $recent_days
),
totals AS (
    SELECT pack, count(*) AS hours, avg(cell_spread_v) AS spread_v FROM recent GROUP BY pack
),
cells AS (
    SELECT
        pack, weakest_cell AS cell, count(*) AS hours_weakest, avg(weakest_cell_v) AS deviation_v,
        avg(weakest_cell_soc_deviation) AS soc_deviation, avg(weakest_cell_resistance_ratio) AS resistance_ratio
    FROM recent GROUP BY pack, weakest_cell
)
SELECT type, pack, cell, hours_weakest / hours AS fraction, deviation_v, spread_v, soc_deviation, resistance_ratio
FROM cells JOIN totals USING (pack) JOIN packs USING (pack)
WHERE hours_weakest > 0.5 * hours AND deviation_v < -$weak_cell_v
ORDER BY deviation_v, pack
