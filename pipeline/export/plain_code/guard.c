/* HEAD

   The loop around the step: which samples it trusts, modes, hold, limits, a transfer without a bump. This file is
   yours: the step is the law's and stays as it is; here you add what your plant needs. Nothing is allocated, nothing is
   read or written but through the arguments, and each call ends after a fixed number of operations. */

#include <stddef.h>

#include "lower_guard.h"

#define PV_MARGIN 0.05        /* share of a PV's range beyond which its sensor is broken */
#define READ_BACK_MARGIN 0.02 /* share of an MV's range by which scaling may carry a sound read-back over its ends */
#define MOVE_ROUNDING 1e-9    /* of an MV's larger end: what rounding adds to a move */
#define LARGEST 1.7976931348623157e308

static int is_finite(double x)
{
    return x >= -LARGEST && x <= LARGEST; /* not of a NaN */
}

static double size_of(double x)
{
    return x < 0.0 ? -x : x;
}

static double inside(double x, double low, double high)
{
    return x < low ? low : (x > high ? high : x);
}

static int may_be(double value, double low, double high, double margin)
{
    const double slack = margin * (high - low);
    return low - slack <= value && value <= high + slack;
}

/* Whether an MV may have a value: within its range, or one of its values where it is discrete. */
static int mv_may_be(int k, double value, double margin)
{
    const int first = UPPER_MV_FIRST[k];
    const int last = UPPER_MV_FIRST[k + 1];
    if (first == last) {
        return may_be(value, UPPER_MV_LOW[k], UPPER_MV_HIGH[k], margin);
    }
    for (int i = first; i < last; ++i) {
        if (UPPER_MV_VALUES[i] == value) {
            return 1;
        }
    }
    return 0;
}

/* Whether an MV may go from what is applied to a value in a period. */
static int may_move(int k, double applied, double value)
{
    const double low = size_of(UPPER_MV_LOW[k]);
    const double high = size_of(UPPER_MV_HIGH[k]);
    const double most = UPPER_MV_MAX_MOVE[k];
    const double way = size_of(value - inside(applied, UPPER_MV_LOW[k], UPPER_MV_HIGH[k]));
    return !(most > 0.0) || way <= most + MOVE_ROUNDING * (low > high ? low : high);
}

/* Whether it is known where the MV stands. */
static int placed(const lower_loop *l)
{
    return l->known && !l->lost && !l->taken;
}

static void cold(lower_loop *l)
{
    for (int i = 0; i < UPPER_N_STATE; ++i) {
        l->state[i] = 0.0;
    }
}

/* A fault: no past any more. In AUTO the MV is held until recover_after good samples, or until the operator acts. */
static void fail(lower_loop *l, lower_fault why, int which)
{
    l->why = why;
    l->which = which;
    cold(l);
    l->good = 0;
    if (l->mode == UPPER_AUTO || l->held) {
        l->mode = UPPER_HOLD;
        l->held = 1;
    }
}

/* The first MV whose read-back no actuator can hold; UPPER_N_MV if there is none. */
static int implausible(const double *applied)
{
    int k = 0;
    while (k < UPPER_N_MV && mv_may_be(k, applied[k], READ_BACK_MARGIN)) {
        ++k;
    }
    return k;
}

/* Whether a sample may be acted on. `bad` takes what speaks against single PVs alone; 0: it speaks against the sample. */
static int trusted(lower_loop *l, const lower_sample *s, int *bad)
{
    int k;
    for (k = 0; k < UPPER_N_PV; ++k) {
        const int number = is_finite(s->pv[k]);
        const int in_range = number && may_be(s->pv[k], UPPER_PV_LOW[k], UPPER_PV_HIGH[k], PV_MARGIN);
        if (bad != NULL) {
            bad[k] = !in_range;
        } else if (!number) {
            fail(l, UPPER_PV_NUMBER, k);
            return 0;
        } else {
            /* its range is looked at below, after the read-back */
        }
    }
    for (k = 0; k < UPPER_N_DV && UPPER_USES_DV; ++k) {
        if (!is_finite(s->dv[k])) {
            fail(l, UPPER_DV_NUMBER, k);
            return 0;
        }
    }
    k = s->has_mv_applied ? implausible(s->mv_applied) : UPPER_N_MV;
    if (k < UPPER_N_MV) {
        fail(l, UPPER_READ_BACK, k);
        return 0;
    }
    for (k = 0; k < UPPER_N_PV && bad == NULL; ++k) {
        if (!may_be(s->pv[k], UPPER_PV_LOW[k], UPPER_PV_HIGH[k], PV_MARGIN)) {
            fail(l, UPPER_PV_RANGE, k);
            return 0;
        }
    }
    if (!(s->age_s >= 0.0 && s->age_s <= UPPER_PERIOD_S)) {
        fail(l, UPPER_AGE, 0);
        return 0;
    }
    return 1;
}

#if UPPER_USES_FRESH
/* PVs whose readings are bad: predicted for bridge_s, then left out until they are good again. 0 where no PV in use is
   left, where one is gone for longer that is critical or that the law cannot leave out, and where one was never read. */
static int bridged(lower_loop *l, const double *pv)
{
    int first = UPPER_N_PV;
    int any = 0;
    int left = 0;
    for (int k = 0; k < UPPER_N_PV; ++k) {
        l->gone[k] = l->bad[k] ? l->gone[k] + 1.0 : 0.0;
        if (!l->bad[k]) {
            l->pv[k] = pv[k];
            l->read[k] = 1;
        }
    }
    for (int k = 0; k < UPPER_N_PV; ++k) {
        const int use = UPPER_USE_OF_PV[k];
        const int wanted = use >= 0 && l->operate[use < 0 ? 0 : use] > 0.0;
        l->shed[k] = l->bad[k] && !((l->gone[k] - 1.0) * UPPER_PERIOD_S < l->bridge_s);
        if (l->bad[k] && (!l->read[k] || (l->shed[k] && (l->critical[k] || use < 0)))) {
            fail(l, UPPER_PV_NEEDED, k);
            return 0;
        }
        if (l->shed[k] && first == UPPER_N_PV) {
            first = k;
        }
        any = any || wanted;
        left = left || (wanted && !l->shed[k]);
    }
    if (first < UPPER_N_PV && any && !left) {
        fail(l, UPPER_PV_NEEDED, first);
        return 0;
    }
    return 1;
}
#endif

#if UPPER_N_AHEAD > 0
/* Whether what is to come is finite and within ranges; a present value outside its range may stay. */
static int to_come_allowed(const lower_loop *l, const double *dv)
{
    for (int k = 0; k < UPPER_N_AHEAD; ++k) {
        const int of = k % (UPPER_N_SP + UPPER_N_DV);
        const double now = of < UPPER_N_SP ? l->sp[of] : dv[of - UPPER_N_SP];
        const double low = UPPER_AHEAD_LOW[of];
        const double high = UPPER_AHEAD_HIGH[of];
        const double slack = MOVE_ROUNDING * (high - low);
        const double then = now + l->ahead[k];
        if (!is_finite(l->ahead[k]) || then < (now < low ? now : low) - slack || then > (now > high ? now : high) + slack) {
            return 0;
        }
    }
    return 1;
}
#endif

/* Where the MV stands after a command that did not arrive, and after others had it: at the next sound read-back, also of a
   sample that is refused for another reason. A good sample without one says that nothing is read back: the MV before it
   stays, also at once where there has never been a read-back. After a bad one it is nothing to go back to. The same scans
   begin a way by hand from nobody knows where. */
static void find(lower_loop *l, const lower_sample *s, int good_one)
{
    const int back = s != NULL && s->has_mv_applied;
    const int sound = back && implausible(s->mv_applied) == UPPER_N_MV;
    const int blind = l->by_hand && !l->known; /* on a way by hand from nobody knows where */
    l->is_read = l->is_read || back;
    if (!(l->lost || l->taken || blind) || !(back || good_one || !l->is_read)) {
        return;
    }
    l->by_hand = l->by_hand && !(back && (l->lost || !sound)); /* it stays where it is found */
    l->known = back ? sound : l->known;
    l->lost = l->lost && back && !sound;
    l->taken = l->taken && back && !sound;
    for (int k = 0; k < UPPER_N_MV && sound; ++k) {
        l->mv[k] = inside(s->mv_applied[k], UPPER_MV_LOW[k], UPPER_MV_HIGH[k]);
    }
}

/* The step on trusted numbers; its results are taken only if all are finite, in range, and no faster than allowed. */
static int stepped(lower_loop *l, const double *pv, const double *dv)
{
    double mv[UPPER_N_MV];
    double next[UPPER_ROOM(UPPER_N_STATE)];
    double info[UPPER_ROOM(UPPER_N_INFO)];
    int sound = 1;
    int k;
#if UPPER_USES_FRESH
    double fresh[UPPER_N_PV];
    double operate[UPPER_N_OPERATE];
    for (k = 0; k < UPPER_N_OPERATE; ++k) {
        operate[k] = l->operate[k];
    }
    for (k = 0; k < UPPER_N_PV; ++k) {
        fresh[k] = l->bad[k] ? 0.0 : l->fresh[k];
        if (l->shed[k]) {
            operate[UPPER_USE_OF_PV[k]] = 0.0;
        }
    }
#endif
#if UPPER_N_AHEAD > 0
    sound = to_come_allowed(l, dv);
#endif
    (void)dv; /* not read by every law */
    STEP
    for (k = 0; k < UPPER_N_MV; ++k) {
        sound = sound && is_finite(mv[k]) && mv_may_be(k, mv[k], 0.0) && may_move(k, l->applied[k], mv[k]);
    }
    for (k = 0; k < UPPER_N_STATE; ++k) {
        sound = sound && is_finite(next[k]);
    }
    for (k = 0; k < UPPER_N_INFO; ++k) {
        sound = sound && is_finite(info[k]);
    }
    for (k = 0; k < UPPER_N_STATE && sound; ++k) {
        l->state[k] = next[k];
    }
    for (k = 0; k < UPPER_N_INFO && sound; ++k) {
        l->info[k] = info[k];
    }
    for (k = 0; k < UPPER_N_MV && sound; ++k) {
        l->law[k] = mv[k];
    }
    return sound;
}

/* One period nearer to where an operator sent the MV. */
static void move_by_hand(lower_loop *l)
{
    int there = 1;
    for (int k = 0; k < UPPER_N_MV; ++k) {
        const double most = UPPER_MV_MAX_MOVE[k];
        const double way = l->wanted[k] - l->mv[k];
        if (most > 0.0 && size_of(way) > most) {
            l->mv[k] = inside(l->mv[k] + (way < 0.0 ? -most : most), UPPER_MV_LOW[k], UPPER_MV_HIGH[k]);
            there = 0;
        } else {
            l->mv[k] = l->wanted[k];
        }
    }
    l->by_hand = !there;
}

/* Begin the way to where an operator wants the MV. One whose moves are not limited is there, unless all wait for a scan that
   tells where they stand. */
static void send(lower_loop *l, int wait)
{
    l->by_hand = 0;
    for (int k = 0; k < UPPER_N_MV; ++k) {
        if (wait || UPPER_MV_MAX_MOVE[k] > 0.0) {
            l->by_hand = 1;
        } else {
            l->mv[k] = l->wanted[k];
        }
    }
}

static void missed(lower_loop *l, double periods)
{
    for (int k = 0; k < UPPER_N_PV; ++k) {
        l->gone[k] += periods;
    }
}

static void take(lower_loop *l, const lower_sample *s)
{
    int good_one = 0;
    int said;
    int k;
    const double *pv = s != NULL ? s->pv : l->pv;
    if (s == NULL) {
        fail(l, UPPER_NOT_READ, 0);
    } else {
        good_one = trusted(l, s, UPPER_USES_FRESH ? l->bad : NULL);
    }
    if (!good_one) {
        missed(l, 1.0);
    }
#if UPPER_USES_FRESH
    else {
        good_one = bridged(l, s->pv);
        pv = l->pv;
    }
#endif
    find(l, s, good_one);
    l->was_known = l->known;
    said = l->by_hand && !l->known && !l->lost && !l->taken && !(s != NULL && s->has_mv_applied) && (good_one || !l->is_read);
    for (k = 0; k < UPPER_N_MV; ++k) {
        l->before[k] = l->mv[k];
        l->mv[k] = said ? l->wanted[k] : l->mv[k]; /* nobody but the operator says where it is */
    }
    l->known = l->known || said;
    if (s == NULL || !good_one) {
        return;
    }
    if (!s->has_mv_applied && !placed(l)) {
        fail(l, UPPER_MV_NOT_KNOWN, 0);
        return;
    }
    for (k = 0; k < UPPER_N_MV; ++k) {
        const double stands = s->has_mv_applied ? s->mv_applied[k] : l->mv[k];
        l->applied[k] = inside(stands, UPPER_MV_LOW[k], UPPER_MV_HIGH[k]);
        if (!placed(l) || l->mode == UPPER_SHADOW) {
            l->mv[k] = l->applied[k];
        }
    }
    l->known = 1;
    if (!stepped(l, pv, s->dv)) {
        for (k = 0; k < UPPER_N_MV && l->mode == UPPER_AUTO; ++k) {
            l->mv[k] = l->applied[k];
        }
        fail(l, UPPER_LAW, 0);
        return;
    }
    if (l->held) {
        ++l->good;
        if (l->good == l->recover_after) {
            lower_set_mode(l, UPPER_AUTO);
        }
    }
    for (k = 0; k < UPPER_N_MV && l->mode == UPPER_AUTO; ++k) {
        l->mv[k] = l->law[k];
    }
    if (!l->held) {
        l->why = UPPER_NONE;
    }
}

void lower_begin(lower_loop *l, lower_mode mode, long recover_after)
{
    int k;
    cold(l);
    for (k = 0; k < UPPER_N_SP; ++k) {
        l->sp[k] = UPPER_SP_MIDDLE[k];
    }
    for (k = 0; k < UPPER_N_MV; ++k) {
        const double middle = UPPER_MV_MIDDLE[k];
        l->mv[k] = middle;
        l->before[k] = middle;
        l->applied[k] = middle;
        l->wanted[k] = middle;
        l->law[k] = middle;
    }
    for (k = 0; k < UPPER_N_INFO; ++k) {
        l->info[k] = 0.0;
    }
    for (k = 0; k < UPPER_N_PV; ++k) {
        l->pv[k] = 0.5 * (UPPER_PV_LOW[k] + UPPER_PV_HIGH[k]);
        l->gone[k] = 0.0;
        l->bad[k] = 0;
        l->shed[k] = 0;
        l->read[k] = 0;
        l->critical[k] = 0;
        l->fresh[k] = 1.0;
    }
#if UPPER_N_OPERATE > 0
    for (k = 0; k < UPPER_N_OPERATE; ++k) {
        l->operate[k] = UPPER_OPERATE_DEFAULT[k];
    }
    l->bridge_s = UPPER_BRIDGE_S;
#endif
#if UPPER_N_AHEAD > 0
    for (k = 0; k < UPPER_N_AHEAD; ++k) {
        l->ahead[k] = 0.0;
    }
#endif
    l->mode = mode;
    l->why = UPPER_NONE;
    l->which = 0;
    l->recover_after = recover_after;
    l->good = 0;
    l->held = 0;
    l->lost = 0;
    l->taken = 0;
    l->by_hand = 0;
    l->hand = 0;
    l->is_read = 0;
    l->known = 0;
    l->was_known = 0;
    l->max_gap = 3.0;
}

int lower_writes(const lower_loop *l)
{
    return placed(l) && l->mode != UPPER_SHADOW;
}

int lower_set_sp(lower_loop *l, const double *sp)
{
    int k;
    for (k = 0; k < UPPER_N_SP; ++k) {
        if (!may_be(sp[k], UPPER_SP_LOW[k], UPPER_SP_HIGH[k], 0.0)) {
            return 0;
        }
    }
    for (k = 0; k < UPPER_N_SP; ++k) {
        l->sp[k] = sp[k];
    }
    return 1;
}

int lower_set_mv(lower_loop *l, const double *mv)
{
    int k;
    if (l->lost || l->mode != UPPER_MANUAL) {
        return 0;
    }
    for (k = 0; k < UPPER_N_MV; ++k) {
        if (!mv_may_be(k, mv[k], 0.0)) {
            return 0;
        }
    }
    for (k = 0; k < UPPER_N_MV; ++k) {
        l->wanted[k] = mv[k];
    }
    l->hand = 1;
    send(l, l->taken || !l->known);
    return 1;
}

void lower_set_mode(lower_loop *l, lower_mode mode)
{
    l->by_hand = l->by_hand && l->mode == mode;
    l->hand = l->hand && l->mode == mode;
    l->taken = mode != UPPER_SHADOW && (l->taken || l->mode == UPPER_SHADOW);
    l->mode = mode;
    l->held = 0;
    l->good = 0;
}

#if UPPER_N_OPERATE > 0
int lower_set_operate(lower_loop *l, const double *operate)
{
    int k;
    for (k = 0; k < UPPER_N_OPERATE; ++k) {
        const int is_switch = UPPER_OPERATE_SWITCH[k];
        const double value = operate[k];
        const int in_range = value >= UPPER_OPERATE_LOW[k] && value <= UPPER_OPERATE_HIGH[k];
        if (!in_range || (is_switch && !(value <= 0.0) && !(value >= 1.0)) || value > operate[UPPER_OPERATE_ABOVE[k]]) {
            return 0;
        }
    }
    for (k = 0; k < UPPER_N_OPERATE; ++k) {
        l->operate[k] = operate[k];
    }
    return 1;
}
#endif

void lower_gap(lower_loop *l, double periods)
{
    missed(l, periods);
    if (periods > l->max_gap) {
        cold(l);
    }
}

void lower_unwritten(lower_loop *l)
{
    const int goes = l->hand && (l->known || l->by_hand);
    for (int k = 0; k < UPPER_N_MV; ++k) {
        l->wanted[k] = l->by_hand ? l->wanted[k] : l->mv[k];
        l->mv[k] = l->before[k];
    }
    l->known = l->was_known;
    if (goes) { /* where it should be is where it goes, from where it stands */
        send(l, !l->known);
    }
    l->lost = 1;
    fail(l, UPPER_NOT_WRITTEN, 0);
}

int lower_scan(lower_loop *l, const lower_sample *s)
{
    take(l, s);
    if (l->by_hand && lower_writes(l)) {
        move_by_hand(l);
    }
    l->hand = l->mode == UPPER_MANUAL;
    return lower_writes(l);
}
