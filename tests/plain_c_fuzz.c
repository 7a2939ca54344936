/* Random samples, requests, gaps and states on the guard of LAW: no MV that it lets through may leave its range, be
   faster than its rate, or be no number. The generator is xorshift64 (Marsaglia, Journal of Statistical Software 8
   (2003) 14), so that a seed gives the same history everywhere. */

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#include "LAW_guard.h"

/* The header has no range of a measured disturbance: the guard asks for a number. */
static const double dv_low[] = {DV_LOW};
static const double dv_high[] = {DV_HIGH};

static uint64_t word;

static double drawn(void) /* 0 to 1 */
{
    word ^= word << 13;
    word ^= word >> 7;
    word ^= word << 17;
    return (double)(word >> 11) / 9007199254740992.0;
}

static int one_in(double n)
{
    return drawn() * n < 1.0;
}

static double strange(void)
{
    static const double some[] = {0.0, -0.0, 1e308, -1e308, 5e-324, 1e-300, 1e30, -1e30};
    const int k = (int)(drawn() * 11.0);
    return k < 8 ? some[k] : (k == 8 ? NAN : (k == 9 ? INFINITY : -INFINITY));
}

/* Mostly within a range, at times at its ends or a little beyond, seldom no value of this world. */
static double about(double low, double high, double oddness)
{
    if (one_in(oddness)) {
        return one_in(2.0) ? strange() : low + (3.0 * drawn() - 1.0) * (high - low);
    }
    return one_in(20.0) ? (one_in(2.0) ? low : high) : low + drawn() * (high - low);
}

/* Where the actuators stand, which others move, too, and what the guard last had written: a refused sample does not
   show where they were moved, and the guard stays with its own command then. */
static double plant[CAP_N_MV];
static double told[CAP_N_MV];

/* Where an operator last sent the MVs. It is where they stand, too, in a scan that reads nothing back while it is not
   known where they are, if none ever did or the sample is good: that one jump is the operator's. */
static double sent[CAP_N_MV];

/* Since the start: whether the plant reads its MVs back, whether it ever did, and how many more scans belong to it: in
   those a plant is read badly, and operators act, as often as not. */
static int reads = 1;
static int has_read;
static long start;

static long wrong, written, held, blind;

static void looked_at(const LAW_loop *l, int writes, int may_jump, long scan)
{
    int jumps = 0;
    for (int k = 0; k < CAP_N_MV && writes; ++k) {
        const double size = fabs(CAP_MV_LOW[k]) > fabs(CAP_MV_HIGH[k]) ? fabs(CAP_MV_LOW[k]) : fabs(CAP_MV_HIGH[k]);
        const double most = CAP_MV_MAX_MOVE[k] + 2e-9 * size;
        const int inside = isfinite(l->mv[k]) && l->mv[k] >= CAP_MV_LOW[k] && l->mv[k] <= CAP_MV_HIGH[k];
        const double from_plant = fabs(l->mv[k] - plant[k]);
        const double from_told = fabs(l->mv[k] - told[k]);
        const int slow = !(CAP_MV_MAX_MOVE[k] > 0.0) || from_plant <= most || from_told <= most;
        const int said = may_jump && l->mv[k] >= sent[k] && l->mv[k] <= sent[k];
        jumps = jumps || !slow;
        if (!inside || !(slow || said)) {
            printf("scan %ld: MV %d goes from %.17g to %.17g\n", scan, k, plant[k], l->mv[k]);
            ++wrong;
        }
    }
    blind += jumps;
}

static void asked(LAW_loop *l)
{
    double sp[CAP_ROOM(CAP_N_SP)];
    double mv[CAP_N_MV];
    if (one_in(10.0)) {
        for (int k = 0; k < CAP_N_SP; ++k) {
            sp[k] = about(CAP_SP_LOW[k], CAP_SP_HIGH[k], 10.0);
        }
        (void)LAW_set_sp(l, sp);
    }
    if (one_in(start > 0 ? 2.0 : 10.0)) {
        for (int k = 0; k < CAP_N_MV; ++k) {
            mv[k] = about(CAP_MV_LOW[k], CAP_MV_HIGH[k], 10.0);
        }
        if (LAW_set_mv(l, mv)) {
            for (int k = 0; k < CAP_N_MV; ++k) {
                sent[k] = mv[k];
            }
        }
    }
    if (one_in(40.0)) {
        LAW_set_mode(l, one_in(3.0) ? CAP_MANUAL : (one_in(3.0) ? CAP_SHADOW : CAP_AUTO));
    }
    if (one_in(50.0)) {
        LAW_gap(l, 6.0 * drawn());
    }
#if CAP_N_OPERATE > 0
    if (one_in(10.0)) {
        double operate[CAP_N_OPERATE];
        for (int k = 0; k < CAP_N_OPERATE; ++k) {
            const double ends = about(CAP_OPERATE_LOW[k], CAP_OPERATE_HIGH[k], 200.0);
            operate[k] = one_in(3.0) ? (CAP_OPERATE_SWITCH[k] ? floor(2.0 * drawn()) : ends) : l->operate[k];
        }
        (void)LAW_set_operate(l, operate);
    }
#endif
#if CAP_N_AHEAD > 0
    if (one_in(10.0)) {
        for (int k = 0; k < CAP_N_AHEAD; ++k) {
            l->ahead[k] = one_in(4.0) ? about(-1.0, 1.0, 100.0) : 0.0;
        }
    }
#endif
    if (one_in(100.0)) { /* a state that no law has left: memory of another task, a restart by half */
        for (int k = 0; k < CAP_N_STATE; ++k) {
            l->state[k] = one_in(5.0) ? strange() : 100.0 * (drawn() - 0.5);
        }
    }
}

/* The same thousand good samples again and again: the largest difference of the
   state between the end of the eleventh time and the end of the last. */
static double drift(LAW_loop *l, long scans)
{
    static LAW_sample s[1000];
    double state[CAP_ROOM(CAP_N_STATE)];
    double most = 0.0;
    for (int i = 0; i < 1000; ++i) {
        for (int k = 0; k < CAP_N_PV; ++k) {
            s[i].pv[k] = CAP_PV_LOW[k] + drawn() * (CAP_PV_HIGH[k] - CAP_PV_LOW[k]);
        }
        for (int k = 0; k < CAP_N_DV; ++k) {
            s[i].dv[k] = dv_low[k] + drawn() * (dv_high[k] - dv_low[k]);
        }
        s[i].has_mv_applied = 0;
        s[i].age_s = 0.0;
    }
    s[0].has_mv_applied = 1;
    for (int k = 0; k < CAP_N_MV; ++k) {
        s[0].mv_applied[k] = plant[k];
    }
    for (long scan = 0; scan < scans / 1000 * 1000; ++scan) {
        written += LAW_scan(l, &s[scan % 1000]);
        held += l->held;
        for (int k = 0; k < CAP_N_STATE && scan == 10999; ++k) {
            state[k] = l->state[k];
        }
    }
    for (int k = 0; k < CAP_N_STATE && scans > 11000; ++k) {
        const double way = fabs(l->state[k] - state[k]);
        most = way > most ? way : most;
    }
    return most;
}

int main(int argc, char **argv)
{
    const long scans = argc > 1 ? atol(argv[1]) : 1000;
    LAW_loop l;
    LAW_sample s;
    word = 88172645463325252u + (argc > 2 ? (uint64_t)atol(argv[2]) : 0u) * 2862933555777941757u;
    for (int k = 0; k < CAP_N_MV; ++k) {
        plant[k] = told[k] = 0.5 * (CAP_MV_LOW[k] + CAP_MV_HIGH[k]);
    }
    LAW_begin(&l, CAP_AUTO, 3);
    if (argc > 3) {
        const double most = drift(&l, scans);
        printf("the state is off by %g\n%ld scans, %ld written, %ld held, 0 wrong\n", most, scans, written, held);
        return 0;
    }
    for (long scan = 0; scan < scans; ++scan) {
        int writes;
        int known;
        if (one_in(500.0)) { /* started again, which forgets where the MVs are */
            LAW_begin(&l, one_in(2.0) ? CAP_MANUAL : CAP_AUTO, 3);
            reads = !one_in(4.0);
            has_read = 0;
            start = (long)(20.0 * drawn());
            for (int k = 0; k < CAP_N_MV; ++k) {
                told[k] = sent[k] = plant[k];
            }
        }
        asked(&l);
        for (int k = 0; k < CAP_N_PV; ++k) {
            s.pv[k] = about(CAP_PV_LOW[k], CAP_PV_HIGH[k], 30.0);
            l.fresh[k] = one_in(5.0) ? 0.0 : 1.0;
        }
        for (int k = 0; k < CAP_N_DV; ++k) {
            s.dv[k] = about(dv_low[k], dv_high[k], 60.0);
        }
        s.has_mv_applied = reads && !one_in(3.0);
        for (int k = 0; k < CAP_N_MV; ++k) {
            const double beyond = 0.02 * (CAP_MV_HIGH[k] - CAP_MV_LOW[k]); /* what scaling may add */
            s.mv_applied[k] = one_in(start > 0 ? 2.0 : 100.0) ? about(CAP_MV_LOW[k], CAP_MV_HIGH[k], 2.0) : plant[k];
            if (s.has_mv_applied && s.mv_applied[k] >= CAP_MV_LOW[k] - beyond && s.mv_applied[k] <= CAP_MV_HIGH[k] + beyond) {
                plant[k] = fmin(fmax(s.mv_applied[k], CAP_MV_LOW[k]), CAP_MV_HIGH[k]); /* somebody else moved it */
            }
        }
        s.age_s = one_in(50.0) ? about(-1.0, 3.0 * CAP_PERIOD_S, 3.0) : 0.0;
        known = l.known;
        {
            const int read = !one_in(start > 0 ? 3.0 : 60.0);
            const int back = read && s.has_mv_applied;
            writes = LAW_scan(&l, read ? &s : 0);
            looked_at(&l, writes, !known && !back && (!has_read || l.why == CAP_NONE), scan);
            has_read = has_read || back;
            start -= start > 0;
        }
        for (int k = 0; k < CAP_N_MV && l.mode == CAP_SHADOW; ++k) {
            const int follows = l.why != CAP_NONE || !s.has_mv_applied || (l.mv[k] >= plant[k] && l.mv[k] <= plant[k]);
            if (writes || !follows) {
                printf("scan %ld: in SHADOW MV %d is %.17g, the plant's %.17g\n", scan, k, l.mv[k], plant[k]);
                ++wrong;
            }
        }
        written += writes;
        held += l.held;
        if (writes && one_in(80.0)) {
            LAW_unwritten(&l);
        } else {
            for (int k = 0; k < CAP_N_MV && writes; ++k) {
                plant[k] = l.mv[k];
            }
        }
        for (int k = 0; k < CAP_N_MV; ++k) {
            told[k] = l.mv[k];
        }
    }
    printf("%ld jumps by hand from nowhere known\n%ld scans, %ld written, %ld held, %ld wrong\n", blind, scans, written, held, wrong);
    return wrong > 0;
}
