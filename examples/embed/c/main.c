/* A loop around a controller in plain C, which `loopwright c FILE.onnx law --name law` writes:

     main [SCANS [PERIOD_S]]      as many scans (20) of a made-up plant, a period apart (that of the law)

   Put your plant into read_plant and write_plant, and your clock into now_s and sleep_until: only they need POSIX. The
   guard, law/law_guard.c, decides which samples are trusted and what is written. Nothing is allocated. */

#define _POSIX_C_SOURCE 200809L
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "law_guard.h"

/* ------------------------------------------------------------------ the plant: put yours here */
static double pv[LAW_N_PV], mv[LAW_N_MV]; /* of the made-up plant */

static void begin_plant(void) {
  for (int i = 0; i < LAW_N_PV; i++) pv[i] = LAW_PV_LOW[i] + 0.3 * (LAW_PV_HIGH[i] - LAW_PV_LOW[i]);
  for (int i = 0; i < LAW_N_MV; i++) mv[i] = LAW_MV_MIDDLE[i];
}

/* Read PVs, measured disturbances and the MV that the plant received over the last period; 0 if you cannot. Here each PV
   goes a tenth of its way to where the first MV sends it. */
static int read_plant(law_sample *s) {
  const double share = (mv[0] - LAW_MV_LOW[0]) / (LAW_MV_HIGH[0] - LAW_MV_LOW[0]);
  for (int i = 0; i < LAW_N_PV; i++) {
    pv[i] += 0.1 * (LAW_PV_LOW[i] + share * (LAW_PV_HIGH[i] - LAW_PV_LOW[i]) - pv[i]);
    s->pv[i] = pv[i];
  }
#if LAW_N_DV > 0
  for (int i = 0; i < LAW_N_DV; i++) s->dv[i] = 0.5 * (LAW_DV_LOW[i] + LAW_DV_HIGH[i]);
#endif
  for (int i = 0; i < LAW_N_MV; i++) s->mv_applied[i] = mv[i];
  s->has_mv_applied = 1;
  s->age_s = 0.0; /* since the PVs were measured */
  return 1;
}

/* Write the MV; 0 if you cannot. */
static int write_plant(const double *wanted) {
  for (int i = 0; i < LAW_N_MV; i++) mv[i] = wanted[i];
  return 1;
}

/* ------------------------------------------------------------------ an absolute time grid */
static double now_s(void) {
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static void sleep_until(double at_s) {
  struct timespec until;
  until.tv_sec = (time_t)at_s;
  until.tv_nsec = (long)(1e9 * (at_s - (double)until.tv_sec));
  while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL) == EINTR) {
  }
}

/* ------------------------------------------------------------------ the loop */
int main(int n, char **words) {
  static const char *const MODE[] = {"MANUAL", "AUTO", "HOLD", "SHADOW"};
  static law_loop l;
  const long scans = n > 1 ? strtol(words[1], NULL, 10) : 20;
  const double period_s = n > 2 ? strtod(words[2], NULL) : LAW_PERIOD_S, start_s = now_s();
  begin_plant();
  law_begin(&l, LAW_AUTO, 5); /* after a fault five good samples return to AUTO */
  for (long k = 0; k < scans; k++) {
    law_sample s;
    sleep_until(start_s + (double)k * period_s);
    double late_s = now_s() - (start_s + (double)k * period_s);
    const long missed = late_s > 0.0 ? (long)(late_s / period_s) : 0; /* periods that have passed whole are skipped */
    if (missed > 0) law_gap(&l, (double)missed);
    k += missed;
    late_s -= (double)missed * period_s;
    if (law_scan(&l, read_plant(&s) ? &s : NULL) && !write_plant(l.mv)) law_unwritten(&l);
    printf("%ld %.2f ms late %s", k, late_s > 0.0 ? 1e3 * late_s : 0.0, MODE[l.mode]);
    for (int i = 0; law_writes(&l) && i < LAW_N_MV; i++) printf(" %.17g", l.mv[i]);
    if (l.why != LAW_NONE) printf(" fault %d at %d", (int)l.why, l.which); /* law_fault in law_guard.h says which */
    printf("\n");
  }
  return 0;
}
