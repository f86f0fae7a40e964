"""Tools shared by solvers: conversion and sequences of QPs, and lists of backends."""
