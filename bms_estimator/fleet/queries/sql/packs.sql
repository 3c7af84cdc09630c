-- Type of each pack, with its first day and its last hour. Needs: days.
CREATE TEMP TABLE packs AS
SELECT
    pack,
    format(
        '{} {}s{}p{}', arg_max(cell, day), arg_max(series, day), arg_max(parallel, day),
        coalesce(format(' {:.4g} Ah', arg_max(capacity_ah, day)), '')
    ) AS type,
    min(day) AS first_day,
    max(last_hour) AS last_hour
FROM days
GROUP BY pack
