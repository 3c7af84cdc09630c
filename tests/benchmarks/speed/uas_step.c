/* Step of the adaptive observer of the thesis in C, with which the speed of the numba kernel is compared. For one sample:
 * checks of the input, Algorithm 1 of the thesis with equations (3.12), (3.13), (3.18) and (4.1), detection of a lost lock,
 * and a row of the trace. It computes what bms_estimator/kernels/{step,start,current_check}.py, kernels/observer/ and
 * kernels/cell_model/chen_mora.py do, with the same names. observer_in_c.py writes records.h from their record types. */

#include <math.h>
#include <stddef.h>
#include <stdint.h>

#include "records.h"

#define SMALLEST_LOOP 0.1     /* lower limit of 1 + N R_s, by which the tracking error is divided */
#define GAP_RATIO 3.0         /* a step longer than so many previous steps is a gap */
#define UNMEASURED_S 60.0     /* beyond this interval the current between two samples counts as unknown [s] */
#define LONGEST_FLOW_S 3600.0 /* maximum time over which charge is counted between two samples [s] */
#define SATURATED_BITS 3u     /* status of a sample: voltage or current beyond the range of the converter */
#define MAX_TIME_S 1e30       /* maximum magnitude of a time stamp [s] */

enum verdict { ACCEPTED, NOT_FINITE, OUT_OF_RANGE, REPEATED, SATURATED, CONTRADICTED };
enum nussbaum { MITTAG_LEFFLER, K2_COS, K_COS_SQRT, LN_COS_SQRT_LN };

/* circuit element over SOC */
static double element(double amplitude, double exponent, double offset, double soc) /* (2.5)-(2.9) */
{
    return amplitude * exp(-exponent * soc) + offset;
}

/* OCV by cubic interpolation of a table with slopes, linear outside SOC 0..1 [V] */
static double ocv(double soc, const settings_t *p)
{
    const int last = OCV_POINTS - 1;
    const double *v = p->ocv_v, *slope = p->ocv_slope_v;
    if (soc <= 0.0)
        return v[0] + soc * slope[0];
    if (soc >= 1.0)
        return v[last] + (soc - 1.0) * slope[last];
    double position = soc * last;
    int i = (int)position < last - 1 ? (int)position : last - 1;
    double t = position - i, step = 1.0 / last;
    double w = t * t * (3.0 - 2.0 * t), bend = t * (1.0 - t) * step;
    return v[i] + w * (v[i + 1] - v[i]) + bend * ((1.0 - t) * slope[i] - t * slope[i + 1]);
}

/* inverse of ocv: bisection over the table, then the Illinois method within an interval */
static double soc_from_ocv(double voltage_v, const settings_t *p)
{
    const int last = OCV_POINTS - 1;
    if (voltage_v <= p->ocv_v[0])
        return 0.0;
    if (voltage_v >= p->ocv_v[last])
        return 1.0;
    int below = 0, above = last;
    while (above - below > 1) {
        int middle = (below + above) / 2;
        if (p->ocv_v[middle] < voltage_v)
            below = middle;
        else
            above = middle;
    }
    double low = (double)below / last, high = (double)above / last, soc = low;
    double miss_low = p->ocv_v[below] - voltage_v, miss_high = p->ocv_v[above] - voltage_v;
    int side = 0;
    for (int n = 0; n < 50; n++) {
        soc = (low * miss_high - high * miss_low) / (miss_high - miss_low);
        double miss = ocv(soc, p) - voltage_v;
        if (fabs(miss) < INVERSE_ERROR_V)
            break;
        if (miss < 0.0) {
            low = soc, miss_low = miss;
            miss_high *= side == -1 ? 0.5 : 1.0;
            side = -1;
        } else {
            high = soc, miss_high = miss;
            miss_low *= side == 1 ? 0.5 : 1.0;
            side = 1;
        }
    }
    return soc;
}

/* SOC below which a capacitance is not positive */
static double delta(double exponent, double offset, double amplitude) /* (2.11), (2.12) */
{
    return -log(offset / amplitude) / exponent;
}

static void update_margins(state_t *s)
{
    s->delta_1 = delta(s->a[8], s->a[9], s->a[7]);
    s->delta_2 = delta(s->a[11], s->a[12], s->a[10]);
}

/* Mittag-Leffler function of -r^alpha: a series for small r, otherwise a wave plus a tabulated decay */
static double mittag_leffler(double r, const settings_t *p)
{
    if (r <= SERIES_LIMIT) {
        double z = pow(r, p->alpha), total = 0.0;
        for (int j = SERIES_TERMS - 1; j >= 0; j--)
            total = total * z + p->ml_series[j];
        return total;
    }
    double angle = M_PI / p->alpha;
    double wave = 2.0 / p->alpha * exp(r * cos(angle)) * cos(r * sin(angle));
    double step = 1.0 / (1.0 + SERIES_LIMIT) / (TABLE_POINTS - 1);
    double position = 1.0 / (1.0 + r) / step;
    int i = (int)position < TABLE_POINTS - 2 ? (int)position : TABLE_POINTS - 2;
    double t = position - i, w = t * t * (3.0 - 2.0 * t), bend = t * (1.0 - t) * step;
    const double *v = p->ml_decay, *slope = p->ml_decay_slope;
    return wave + v[i] + w * (v[i + 1] - v[i]) + bend * ((1.0 - t) * slope[i] - t * slope[i + 1]);
}

/* N(k), limited */
static double nussbaum_gain(double k, const settings_t *p)
{
    double gain, log_k;
    switch (p->nussbaum) {
    case K2_COS:
        gain = k * k * cos(k);
        break;
    case K_COS_SQRT:
        gain = k * cos(sqrt(fabs(k)));
        break;
    case LN_COS_SQRT_LN:
        log_k = log(fmax(k, 1.0));
        gain = log_k * cos(sqrt(log_k));
        break;
    default:
        gain = mittag_leffler(p->gain_scale * k, p);
    }
    return fmin(fmax(gain, -p->gain_limit), p->gain_limit);
}

/* integral of exp(rate t) over 0..dt_s */
static double integral_of_exponential(double rate, double dt_s)
{
    double x = rate * dt_s;
    return fabs(x) < 1e-8 ? dt_s * (1.0 + 0.5 * x) : expm1(x) / rate;
}

/* a1..a15 after dt_s under a constant square of the tracking error; s->decay and s->settle are cached for equal steps */
static void adapt(state_t *s, const settings_t *p, double dt_s, double e_squared) /* (3.16)-(3.18) */
{
    if (dt_s != s->decay_dt_s) {
        s->decay_dt_s = dt_s;
        for (int i = 1; i < 16; i++) {
            s->decay[i] = exp(-p->rate[i] * dt_s);
            s->settle[i] = integral_of_exponential(-p->rate[i], dt_s);
        }
    }
    for (int i = 1; i < 16; i++)
        s->a[i] = s->target[i] + (s->a[i] - s->target[i]) * s->decay[i] + p->drive[i] * e_squared * s->settle[i];
}

/* exact step of both RC voltages under a constant gain; return the decay rate of the tracking error [1/s] */
static double states_step(state_t *s, double gain, double drop_v, double tau_ts, double tau_tl, double dt_s)
{
    double mean = -gain - 0.5 * (1.0 / tau_ts + 1.0 / tau_tl);
    double half = 0.5 * (1.0 / tau_tl - 1.0 / tau_ts);
    double q = fmax(sqrt(half * half + gain * gain), 1e-300);
    double low = mean - q, high = mean + q;
    double phi_low = integral_of_exponential(low, dt_s), phi_high = integral_of_exponential(high, dt_s);
    double decay_low = 1.0 + low * phi_low, decay_high = 1.0 + high * phi_high;
    double along = 0.5 * (decay_high + decay_low), across = 0.5 * (decay_high - decay_low) / q;
    double phi_along = 0.5 * (phi_high + phi_low), phi_across = 0.5 * (phi_high - phi_low) / q;
    double u = -gain * drop_v, v_ts = s->v_ts, v_tl = s->v_tl;
    s->v_ts = along * v_ts + across * (half * v_ts - gain * v_tl) + u * (phi_along + phi_across * (half - gain));
    s->v_tl = along * v_tl + across * (-half * v_tl - gain * v_ts) + u * (phi_along + phi_across * (-half - gain));
    return gain >= 0.0 ? low : high;
}

static void start(state_t *s, const settings_t *p, double time_s, double current_a, double voltage_v)
{
    s->time_s = time_s;
    s->current_a = current_a;
    for (int i = 1; i < 16; i++) {
        s->a[i] = p->a_initial[i];
        s->target[i] = p->target[i];
    }
    s->soc = p->soc_initial;
    if (isnan(s->soc))
        s->soc = soc_from_ocv(voltage_v + current_a * element(s->a[13], s->a[14], s->a[15], 1.0), p);
    s->k = p->k0;
    s->gain = nussbaum_gain(s->k, p);
    s->soc_coulomb = s->soc;
    s->lock = s->adapting = s->started = 1;
    s->voltage_estimate_v = ocv(s->soc, p);
    s->innovation_v = voltage_v - s->voltage_estimate_v;
    update_margins(s);
}

/* restart after a loss of lock: initial gain and parameters, RC voltages that explain the measured voltage */
static void recover(state_t *s, const settings_t *p, double voltage_v, double e_o)
{
    s->k = p->k0;
    s->gain = nussbaum_gain(s->k, p);
    s->v_ts = s->v_tl = 0.5 * (e_o - voltage_v);
    for (int i = 1; i < 16; i++)
        s->a[i] = s->target[i];
    s->voltage_estimate_v = voltage_v;
    s->unlocked_s = 0.0;
    update_margins(s);
}

static void watch_lock(state_t *s, const settings_t *p, double dt_s, double voltage_v, double e_o)
{
    int beyond = !(fabs(s->innovation_v) <= p->lock_error_v);
    s->unlocked_s = beyond == (s->lock == 1) ? s->unlocked_s + fmin(dt_s, 0.2 * p->lock_time_s) : 0.0;
    int turned = beyond && s->gain <= 0.0;
    int overflow = !(isfinite(s->v_ts) && isfinite(s->v_tl) && fabs(s->gain) < p->gain_limit);
    int expired = s->unlocked_s >= p->lock_time_s;
    if (turned || overflow || (expired && s->lock == 1)) {
        s->lock = 0;
        s->lock_losses++;
        recover(s, p, voltage_v, e_o);
    } else if (expired) {
        s->lock = 1;
        s->unlocked_s = 0.0;
    } else if (s->gain < p->rearm_gain && !beyond && nussbaum_gain(p->k0, p) > p->rearm_gain) {
        s->k = p->k0;
        s->gain = nussbaum_gain(s->k, p);
        s->gain_rearms++;
    }
}

/* mean current between two samples; after a long interval only what both samples have in common */
static double held_current(double dt_s, double before_a, double now_a)
{
    if (dt_s <= UNMEASURED_S)
        return 0.5 * (before_a + now_a);
    if (before_a * now_a <= 0.0)
        return 0.0;
    return now_a > 0.0 ? fmin(before_a, now_a) : fmax(before_a, now_a);
}

/* SOC down to which the elements are evaluated (erratum 14) */
static double lowest(const state_t *s, const settings_t *p)
{
    return fmax(s->delta_1, s->delta_2) + p->margin_guard;
}

static void observer_step(state_t *s, const settings_t *p, double dt_s, double current_a, double voltage_v)
{
    double charge_as = held_current(dt_s, s->current_a, current_a) * fmin(dt_s, LONGEST_FLOW_S);
    s->soc = s->soc_coulomb = fmin(fmax(s->soc_coulomb - charge_as / p->capacity_as, 0.0), 1.0); /* (3.1) */
    s->current_a = current_a;
    double e_o = ocv(s->soc, p);

    s->adapting = s->soc > lowest(s, p);
    double soc = fmax(s->soc, lowest(s, p));

    const double *a = s->a;
    double ohm_s = p->output_r_s > 0.0 ? p->output_r_s * element(a[13], a[14], a[15], soc) : 0.0;
    double loop = fmax(1.0 + s->gain * ohm_s, SMALLEST_LOOP);
    double e = (voltage_v - e_o + s->v_ts + s->v_tl) / loop; /* (3.15) */
    s->innovation_v = e;

    double tau_ts = element(a[1], a[2], a[3], soc) * element(-a[7], a[8], a[9], soc);
    double tau_tl = element(a[4], a[5], a[6], soc) * element(-a[10], a[11], a[12], soc);
    double rate_e = states_step(s, s->gain / loop, voltage_v - e_o, tau_ts, tau_tl, dt_s);
    double mean_square = integral_of_exponential(2.0 * rate_e * dt_s, 1.0);

    if (s->adapting) {
        adapt(s, p, dt_s, e * e * mean_square);
        update_margins(s);
    }

    double excess = fmax(fabs(e) - p->dead_zone_v, 0.0);
    if (excess > 0.0) {
        s->k += excess * excess * mean_square * dt_s; /* (3.13) */
        s->gain = nussbaum_gain(s->k, p);
    }
    s->voltage_estimate_v = e_o - s->v_ts - s->v_tl; /* (4.1) */
    if (p->output_r_s > 0.0)
        s->voltage_estimate_v = voltage_v - (voltage_v - s->voltage_estimate_v) / loop; /* (3.14) */
    watch_lock(s, p, dt_s, voltage_v, e_o);
}

/* checks of the input, in the order of the kernel */
static enum verdict judge(state_t *s, const settings_t *p, const sample_t *x)
{
    if (!(isfinite(x->time_s) && isfinite(x->current_a) && isfinite(x->voltage_v))) {
        s->dropped_not_finite++;
        return NOT_FINITE;
    }
    if (x->status & SATURATED_BITS) {
        s->dropped_saturated++;
        return SATURATED;
    }
    if (!(p->voltage_min_v <= x->voltage_v && x->voltage_v <= p->voltage_max_v &&
          fabs(x->current_a) <= p->current_max_a) ||
        fabs(x->time_s) > MAX_TIME_S) {
        s->dropped_range++;
        return OUT_OF_RANGE;
    }
    if (s->started && x->time_s == s->time_s) {
        s->dropped_repeated++;
        return REPEATED;
    }
    return ACCEPTED;
}

static double max_step(const state_t *s, const settings_t *p)
{
    return fmax(p->gap_s, GAP_RATIO * s->step_s);
}

/* the voltage follows the change to current_a, or the change may be invisible */
static int voltage_follows(const check_t *d, const settings_t *p, double dt_s, double current_a, double voltage_v)
{
    double drop_v = p->check_ohm * fabs(current_a - d->reference_a);
    double hidden_v = p->check_slow_ohm * fabs(d->reference_a) * fmin(1.0, dt_s / RC_HIDING_S);
    return drop_v <= p->check_v + hidden_v || fabs(voltage_v - d->reference_v) >= FOLLOWED_FRACTION * drop_v;
}

static int is_near(const check_t *d, double current_a)
{
    return fabs(current_a - d->current_a) <= NEAR_FRACTION * fabs(d->current_a - d->reference_a);
}

/* the current may be a small negative number of 16 bits that was read as an unsigned one */
static int is_wrapped(double current_a)
{
    static const double steps_a[] = STEPS_A;
    int wrapped = 0;
    for (size_t i = 0; i < sizeof steps_a / sizeof *steps_a; i++) {
        double below_a = UINT16_VALUES * steps_a[i] - fabs(current_a);
        wrapped |= 0.0 <= below_a && below_a <= MAX_WRAPPED_FRACTION * UINT16_VALUES * steps_a[i];
    }
    return wrapped;
}

static void reject_waiting(state_t *s, check_t *d)
{
    s->dropped_contradicted += d->waiting;
    d->waiting = 0;
}

/* the sample waits for the next one, or is rejected */
static int is_doubtful(state_t *s, const settings_t *p, check_t *d, const sample_t *x)
{
    double dt_s = x->time_s - s->time_s;
    if (!s->started || x->status & HELD_BITS || !(dt_s > 0.0) || dt_s - d->seen_s > max_step(s, p) ||
        voltage_follows(d, p, dt_s, x->current_a, x->voltage_v))
        return 0;
    if (is_wrapped(x->current_a)) {
        d->seen_s = dt_s;
        s->dropped_contradicted++;
        return 1;
    }
    if (d->waiting > 0 && !is_near(d, x->current_a))
        reject_waiting(s, d);
    if (d->waiting == MAX_WAITING)
        return 0;
    if (d->waiting == 0)
        d->age_s = dt_s, d->current_a = x->current_a, d->voltage_v = x->voltage_v;
    d->seen_s = dt_s;
    d->waiting++;
    return 1;
}

/* this sample confirms the samples that wait; otherwise they are rejected */
static int accept_waiting(state_t *s, const settings_t *p, check_t *d, double dt_s, const sample_t *x)
{
    d->seen_s = 0.0;
    if (d->waiting == 0)
        return 0;
    double late_s = dt_s - d->age_s;
    if (late_s > 0.0 &&
        (is_near(d, x->current_a) ||
         (late_s <= max_step(s, p) && voltage_follows(d, p, d->age_s, d->current_a, x->voltage_v)))) {
        s->samples += d->waiting;
        d->waiting = 0;
        return 1;
    }
    reject_waiting(s, d);
    return 0;
}

static enum verdict step(state_t *s, const settings_t *p, check_t *d, const sample_t *x)
{
    enum verdict verdict = judge(s, p, x);
    if (verdict != ACCEPTED)
        return verdict;
    if (is_doubtful(s, p, d, x))
        return CONTRADICTED;
    s->samples++;
    if (!s->started) {
        d->reference_a = x->current_a, d->reference_v = x->voltage_v;
        start(s, p, x->time_s, x->current_a, x->voltage_v);
        return verdict;
    }
    double dt_s = x->time_s - s->time_s;
    if (accept_waiting(s, p, d, dt_s, x)) {
        observer_step(s, p, d->age_s, d->current_a, d->voltage_v);
        dt_s -= d->age_s;
    }
    if (!(x->status & HELD_BITS))
        d->reference_a = x->current_a, d->reference_v = x->voltage_v;
    s->time_s = x->time_s;
    if (dt_s < 0.0) {
        s->time_steps_back += isfinite(dt_s) ? 1 : 0;
        s->current_a = x->current_a;
        return verdict;
    }
    if (dt_s > max_step(s, p))
        s->gaps++;
    s->step_s = dt_s;
    observer_step(s, p, dt_s, x->current_a, x->voltage_v);
    return verdict;
}

static void write_row(trace_t *row, const state_t *s, const settings_t *p, const sample_t *x)
{
    row->time_s = x->time_s;
    row->voltage_v = x->voltage_v;
    row->current_a = x->current_a;
    row->temperature_c = x->temperature_c;
    row->soc = s->soc;
    row->voltage_estimate_v = s->voltage_estimate_v;
    row->innovation_v = row->tracking_error_v = s->innovation_v;
    row->nussbaum_gain = s->gain;
    row->k = s->k;
    row->delta_1 = s->delta_1;
    row->delta_2 = s->delta_2;
    row->delta_configured = 1;
    for (int i = 7; i < 13; i++)
        row->delta_configured &= s->target[i] == p->target[i];
    row->stability_margin = row->stability_margin_std = NAN;
    row->lock = s->lock;
    row->converged = fabs(s->innovation_v) < p->epsilon_v;
    row->soc_coulomb = s->soc_coulomb;
    row->soc_ocv = row->soc_std = NAN;
    row->r_s_ohm = row->r_ts_ohm = row->tau_ts_s = row->r_tl_ohm = row->tau_tl_s = NAN;
    row->r_s_std_ohm = row->r_ts_std_ohm = row->tau_ts_std_s = row->r_tl_std_ohm = row->tau_tl_std_s = NAN;
}

/* process n samples; return the number of rows written to the trace */
int64_t run(state_t *state, const settings_t *settings, check_t *check, const sample_t *samples, trace_t *trace, int64_t n)
{
    int64_t rows = 0;
    for (int64_t j = 0; j < n; j++)
        if (step(state, settings, check, samples + j) == ACCEPTED)
            write_row(trace + rows++, state, settings, samples + j);
    return rows;
}
